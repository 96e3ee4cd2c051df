// Keys for a team's page: each presses what carries it. Whoever needs the letters turns them off.
"use strict";
const keys = document.querySelector("#keys");
if (keys) {
  keys.closest("p").hidden = false;
  keys.checked = localStorage.getItem("keys") !== "off";
  keys.addEventListener("change", () => localStorage.setItem("keys", keys.checked ? "on" : "off"));
  document.addEventListener("keydown", (event) => {
    if (!keys.checked || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (event.target.closest("input:not([type=checkbox]), select, textarea")) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const wanted = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
    if (!wanted) return;
    event.preventDefault();
    if (!wanted.matches("input")) return wanted.click();
    wanted.focus();
    wanted.select();
  });
}
