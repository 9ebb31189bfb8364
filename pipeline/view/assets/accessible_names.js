// Give Dash's controls the names and roles that screen readers read; Dash has no properties for them.
const NAMED = [
  ["#shown", { "aria-label": "show", role: "group" }],
  ["#border [role=slider], #border input", { "aria-label": "border, per cent of the width" }],
  ["#wall", { "aria-label": "the wall in 3D", role: "group" }],
  ["#map", { "aria-label": "map of the wall", role: "group" }],
];

function repair() {
  for (const [selector, attributes] of NAMED)
    for (const element of document.querySelectorAll(selector))
      for (const [name, value] of Object.entries(attributes))
        if (element.getAttribute(name) !== value) element.setAttribute(name, value);
  for (const option of document.querySelectorAll("#shown [role=option]"))  // each holds a checkbox, which says the same
    for (const name of ["role", "aria-selected"]) option.removeAttribute(name);
  for (const option of document.querySelectorAll("#shown label[aria-selected]")) option.removeAttribute("aria-selected");
  for (const target of document.querySelectorAll(".dash-dropdown-focus-target[aria-hidden]")) {
    target.removeAttribute("aria-hidden");
    target.setAttribute("aria-label", target.closest("label")?.firstElementChild?.textContent ?? "choose");
  }
}

new MutationObserver(repair).observe(document.documentElement, {
  childList: true, subtree: true, attributes: true, attributeFilter: ["aria-selected", "aria-hidden"],
});
