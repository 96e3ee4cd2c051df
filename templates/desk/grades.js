// Keys for a team's page and the list of several: each presses what carries it. Whoever needs the letters turns them off.
"use strict";
const keys = document.querySelector("#keys");
if (keys) {
  const help = keys.closest("details"), nothing = document.querySelector("#no-key");
  help.hidden = false;
  keys.checked = localStorage.getItem("keys") !== "off";
  const mark = () => document.body.classList.toggle("keyed", keys.checked);
  mark();
  keys.addEventListener("change", () => {
    localStorage.setItem("keys", keys.checked ? "on" : "off");
    mark();
  });
  const switched = "[type=checkbox], [type=radio]";
  document.addEventListener("keydown", (event) => {
    if (!keys.checked || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (event.target.closest(`input:not(${switched}), select, textarea`)) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const wanted = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
    if (event.key === "Escape") help.open = false;
    if (nothing) {
      nothing.hidden = Boolean(wanted) || !nothing.dataset[event.key];
      nothing.textContent = nothing.dataset[event.key] ?? "";
    }
    if (!wanted) return;
    event.preventDefault();
    if (!wanted.matches("input")) return wanted.click();
    if (!wanted.matches(switched)) return edit(wanted);
    wanted.click();
    edit(document.querySelector("#why"));
  });
  const edit = (field) => {
    field.value ||= field.dataset.usual ?? "";
    field.focus();
    field.select();
  };
  // A number that was typed before would count in place of a step that is chosen after it.
  const other = document.querySelector("[name=other]");
  for (const step of document.querySelectorAll("[type=radio][name=points]"))
    step.addEventListener("change", () => (other.value = ""));
}
