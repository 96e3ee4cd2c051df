// What the desk needs besides htmx: stages of long work as they come, a place for dropped files, and
// that what is typed stays until it is saved.
"use strict";
htmx.onLoad(() => {
  const shown = document.querySelector("[data-events]");
  if (shown && !shown.dataset.followed) {
    shown.dataset.followed = "yes";
    const events = new EventSource(shown.dataset.events);
    const end = () => {
      events.close();
      if (shown.isConnected)
        htmx.ajax("GET", location.pathname, { target: "#main", select: "#main > *", swap: "innerHTML show:none" });
    };
    events.addEventListener("stage", (event) => {
      if (!shown.isConnected) return events.close();
      shown.querySelector("span").textContent = event.data;
    });
    events.addEventListener("end", end);
  }
  for (const place of document.querySelectorAll(".drop:not([data-open])")) {
    place.dataset.open = "yes";
    const input = place.querySelector("input[type=file]");
    const over = (on) => (event) => {
      event.preventDefault();
      place.classList.toggle("over", on);
    };
    place.addEventListener("dragover", over(true));
    place.addEventListener("dragleave", over(false));
    place.addEventListener("drop", (event) => {
      over(false)(event);
      if (!event.dataTransfer.files.length) return;
      input.files = event.dataTransfer.files;
      input.dispatchEvent(new Event("change", { bubbles: true }));
    });
  }
});
document.addEventListener("htmx:sendError", () => {
  const status = document.querySelector("[role=status]");
  status.textContent = "No answer: the desk has stopped, or the upload is too large.";
});

// An answer replaces all of #main. Of each page, by its heading, is kept what was typed and not sent with the request; it goes
// back when the page comes back. A row is known by its experiment, whose number may have changed.
// So does what somebody unfolded.
const unsaved = new Map(), sent = new WeakMap(), opened = new Set();
let going_on = []; // where the request came from: it does not fold while somebody types there
let typing = null; // the field in which somebody types, and where in it
document.addEventListener("click", (event) => {
  const folded = event.target.closest("summary")?.parentElement;
  if (folded?.id) opened[folded.open ? "delete" : "add"](heading() + folded.id);
});
let before = "";
const heading = () => document.querySelector("h1").textContent;
const switched = (one) => one.type === "checkbox" || one.type === "radio";
const state = (one) => (switched(one) ? one.checked : one.value);
const shown = (one) => {
  if (switched(one)) return one.defaultChecked;
  if (one.tagName !== "SELECT") return one.defaultValue;
  return ([...one.options].find((option) => option.defaultSelected) ?? one.options[0])?.value;
};
const differs = (one) => state(one) !== shown(one);
const key = (one) =>
  [one.form?.dataset.row ?? one.form?.id, one.name.replace(/^experiments\.\d+/, ""), switched(one) && one.value].join("\n");
const typed = (within) => [...within.querySelectorAll("input:not([type=hidden], [type=file]), select, textarea")].filter((one) => one.name);
document.addEventListener("htmx:beforeSend", (event) => {
  const form = event.detail.elt.closest("form");
  if (form) sent.set(event.detail.xhr, new Map(typed(form).map((one) => [one, state(one)])));
});
document.addEventListener("htmx:beforeSwap", (event) => {
  if (event.detail.target.id !== "main") return;
  const went = sent.get(event.detail.xhr) ?? new Map();
  const kept = typed(event.detail.target).filter((one) => (went.has(one) ? state(one) !== went.get(one) : differs(one)));
  before = heading();
  const field = document.activeElement;
  typing = field.id && { id: field.id, at: field.selectionStart, to: field.selectionEnd };
  going_on = [];
  const began = event.detail.requestConfig?.elt; // an answer for several rows lets their group fold
  for (let around = began?.matches(".together") ? null : began?.closest("form, details"); around; around = around.parentElement.closest("details"))
    going_on.push(around.id, ...[...around.querySelectorAll("details[open]")].map((one) => one.id));
  unsaved.set(before, new Map(kept.map((one) => [key(one), state(one)])));
});
document.addEventListener("htmx:afterSwap", (event) => {
  if (event.detail.target.id !== "main") return;
  const kept = unsaved.get(heading()) ?? new Map();
  const back = [];
  for (const one of event.detail.target.querySelectorAll("details[id]")) one.open ||= opened.has(heading() + one.id) || going_on.includes(one.id);
  for (const one of typed(event.detail.target)) {
    if (!kept.has(key(one))) continue;
    one[switched(one) ? "checked" : "value"] = kept.get(key(one));
    back.push(one);
    unfold(one);
  }
  if (heading() !== before) return scrollTo(0, 0); // another page altogether
  go_on_typing();
  rows = back.filter((one) => one.form?.dataset.row && (left.has(key(one)) || one === document.activeElement));
  left.clear();
});
const unfold = (one) => {
  for (let around = one.closest("details"); around; around = around.parentElement.closest("details")) around.open = true;
};
// What is folded cannot have the focus: the row may now be among the understood ones.
const go_on_typing = () => {
  const field = typing && document.getElementById(typing.id);
  if (!field || field === document.activeElement) return;
  unfold(field);
  field.focus();
  if (typing.at != null) field.setSelectionRange(typing.at, typing.to);
};
// A row saves itself when a field is left: also if its last answer was on the way then.
let rows = [];
const left = new Set();
document.addEventListener("change", (event) => left.add(key(event.target)), true);
document.addEventListener("htmx:afterSettle", () => {
  for (const one of rows) {
    const save = () => {
      if (one.isConnected && differs(one) && going.get(one) !== state(one)) one.dispatchEvent(new Event("change", { bubbles: true }));
    };
    if (one === document.activeElement) one.addEventListener("blur", save, { once: true });
    else save();
  }
  rows = [];
});

// What is made of what is saved waits where something typed is not, nor on its way: what stands behind it says how to go on.
let going = new WeakMap();
document.addEventListener("htmx:beforeSend", (event) => {
  const form = event.detail.elt.closest("form");
  if (form) for (const one of typed(form)) going.set(one, state(one));
});
document.addEventListener("htmx:sendError", () => (going = new WeakMap()));
const hold = (event) => {
  const made = event.target.closest("[data-of-saved]");
  if (!made || !typed(document).some((one) => differs(one) && going.get(one) !== state(one))) return;
  event.preventDefault();
  event.stopPropagation();
  made.closest("p").nextElementSibling.hidden = false;
};
document.addEventListener("click", hold, true);
