# `make demo` and `make test` work from an empty clone on a bare Debian or Ubuntu with Python 3.11 to 3.13; see tools/setup.sh.
BIN := .venv/bin

# Many tests start processes, which would compile the program anew each time.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup setup-all demo test types short-tests validate docs format benchmarks nightly

help:
	@echo 'make setup       what the program runs on: environment and system libraries (seconds when they are there)'
	@echo '                 with EXTRAS="detect notebook" those extras too; `scarpsim doctor` says what each is for'
	@echo 'make setup-all   what tests, documentation and benchmarks need too; the targets below do it themselves'
	@echo 'make demo        simulate both sensors on the demo wall, into a new folder under runs/'
	@echo 'make test        lint, spelling, types and tests'
	@echo 'make validate    long statistical tests and trainings, as before a release (see docs/validation/tests.md)'
	@echo 'make docs        the documentation site, in site/index.html'
	@echo 'make format      put the code into the project'"'"'s format'
	@echo 'make benchmarks  speed and memory with an empty and a filled kernel cache, into docs/validation/performance.md (an hour)'
	@echo 'make nightly     robustness at length: 500 drawn inputs a command, the list of bad inputs, the soak (hours)'

setup:
	@sh tools/setup.sh $(EXTRAS)

setup-all:
	@sh tools/setup.sh all

demo: setup
	@out=runs/demo_$$(date +%Y%m%d_%H%M%S) && \
	$(BIN)/simulate --sensor stereo --out $$out/stereo && \
	$(BIN)/simulate --sensor tls --out $$out/tls && \
	printf '\nThe reports:\n  %s\n  %s\n' "$$PWD/$$out/stereo/report.html" "$$PWD/$$out/tls/report.html"

test: setup-all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	@$(MAKE) --no-print-directory --jobs 2 types short-tests  # mypy uses one core: beside the tests it takes half the time

types:
	$(BIN)/mypy

short-tests:
	$(BIN)/pytest -n 2 --dist worksteal -m 'not validation'

validate: setup-all
	$(BIN)/pytest -n 2 --dist worksteal -m validation

docs: setup-all
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@printf 'The site: %s\n' "$$PWD/site/index.html"

format: setup-all
	$(BIN)/ruff check --fix-only -q .
	$(BIN)/ruff format .

benchmarks: setup-all
	$(BIN)/python benchmarks/performance.py

nightly: setup-all
	$(BIN)/python benchmarks/fuzz.py 500
	$(BIN)/python benchmarks/fuzz.py 500 --through
	$(BIN)/python benchmarks/bad_inputs/run.py --jobs 2
	$(BIN)/python benchmarks/soak.py tls
	$(BIN)/python benchmarks/soak.py stereo
