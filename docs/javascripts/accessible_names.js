// Name the theme's search dialog for screen readers, and let the keyboard scroll tables and code that are wider than the window.
const repair = () => {
  document.querySelector(".md-search[role=dialog]")?.setAttribute("aria-label", "Search");
  for (const wide of document.querySelectorAll(".md-typeset__scrollwrap, .md-typeset pre > code, .jp-RenderedText pre"))
    wide.setAttribute("tabindex", "0");
};
document.addEventListener("DOMContentLoaded", repair);
new MutationObserver(repair).observe(document.documentElement, { childList: true, subtree: true });
