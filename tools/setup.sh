#!/bin/sh
# Makes what the project needs on a bare Debian or Ubuntu: uv, the environment in .venv, the system libraries.
#   tools/setup.sh        what the program runs on
#   tools/setup.sh detect notebook    that and some of the extras of pyproject.toml
#   tools/setup.sh all    what tests, documentation and benchmarks need too
# Does only what is not done yet, so that running it again takes a second. Registries are those that pip, uv and apt are
# configured for on this machine.
set -eu
cd "$(dirname "$0")/.."

export UV_PYTHON_DOWNLOADS=never UV_HTTP_TIMEOUT="${UV_HTTP_TIMEOUT:-300}"
unset VIRTUAL_ENV || true  # the project's own .venv, whatever is activated

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$*"; exit 1; }

# Installs Debian packages where we may, else says which line does it.
apt_install() {
    if [ "$(id -u)" = 0 ]; then as_root=""
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then as_root="sudo"
    else as_root=none; fi
    if [ "$as_root" = none ] || ! command -v apt-get >/dev/null 2>&1; then
        fail "missing system packages; install them and run this again:
    sudo apt-get update && sudo apt-get install -y --no-install-recommends $*"
    fi
    say "installing $* with apt-get"
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >&2 ||
        fail "apt-get could not install: $*"
}

# The lists of packages may be absent or old on a bare machine.
apt_update() {
    command -v apt-get >/dev/null 2>&1 || return 0
    if [ "$(id -u)" = 0 ]; then apt-get update -q >&2 || true
    elif command -v sudo >/dev/null 2>&1; then sudo -n apt-get update -q >&2 2>/dev/null || true; fi
}

find_python() {
    for candidate in python3 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; then
            "$candidate" -c 'import os, sys; print(os.path.realpath(sys.executable))'
            return
        fi
    done
    fail "no Python from 3.11 to 3.13 was found; install one (Debian, Ubuntu: apt-get install python3)"
}

uv_is_recent() {
    case "$("$1" --version 2>/dev/null)" in
        "" | "uv 0."[0-7].*) return 1 ;;
    esac
}

install_uv() {
    say "installing uv into .uv"
    "$python" -m venv --clear .uv >/dev/null 2>&1 && .uv/bin/python -m pip install -q uv && return
    rm -rf .uv
    "$python" -m pip --version >/dev/null 2>&1 && "$python" -m pip install -q --target .uv uv
}

extras_known=$(sed -n '/^\[project.optional-dependencies\]/,/^$/s/ = .*//p' pyproject.toml)
groups=--no-default-groups extras="$*"
[ "$extras" != all ] || { groups="" extras=poisson; }
for extra in $extras; do
    printf '%s\n' "$extras_known" | grep -qx -e "$extra" ||
        fail "got '$extra'; allowed: nothing, all, or some of $(echo $extras_known)"
done

python=$(find_python)

uv=uv
uv_is_recent uv || uv=.uv/bin/uv
if ! uv_is_recent "$uv"; then
    if ! install_uv; then
        apt_update
        apt_install python3-venv
        install_uv || fail "uv could not be installed from the package index; see the message of pip above"
    fi
fi

# dataset: `scarpsim dataset --workers`. --inexact keeps what an earlier set-up installed. --compile-bytecode, and compileall for
# what is in this folder: where Python may not write bytecode (PYTHONDONTWRITEBYTECODE, common in containers) a command took 6 s
# longer each time, TensorFlow's import 13 s.
# shellcheck disable=SC2046,SC2086  # a word each
"$uv" sync --compile-bytecode --quiet --locked --inexact $groups $(printf ' --extra %s' dataset $extras) --python "$python" || fail "the environment could not be made from uv.lock"
.venv/bin/python -m compileall -q scene sensors pipeline || fail "the program's own files could not be compiled"

# -P: the script's folder stays off the path, where modules have names of the standard library's.
# shellcheck disable=SC2086
missing_packages() { "$python" -P pipeline/cli/system_libraries.py $extras || fail "the check of the system libraries failed"; }

missing=$(missing_packages)
if [ -n "$missing" ]; then
    apt_update
    # shellcheck disable=SC2046  # one word per package; asked again, since new lists may offer a newer LLVM
    apt_install $(missing_packages)
    missing=$(missing_packages)
    [ -z "$missing" ] || fail "still missing after the installation: $missing"
fi

# The tests look at reports, viewer and documentation in Chromium, and are skipped where there is none.
if [ "$extras" = poisson ] && [ -z "$groups" ] && ! command -v chromium >/dev/null 2>&1; then
    apt_update
    (apt_install chromium) || say "without Chromium the tests of what a browser shows are skipped"
fi
