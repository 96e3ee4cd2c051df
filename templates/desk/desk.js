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
        htmx.ajax("GET", location.pathname + location.search, { source: shown, target: "#main", select: "#main > *", swap: "innerHTML show:none" });
    };
    events.addEventListener("stage", (event) => {
      if (!shown.isConnected) return events.close();
      for (const stage of document.querySelectorAll("[data-events] span, [data-stage]")) stage.textContent = event.data;
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

// The server sends only the parts of the page that differ from these. A part that stays has the version of the file in it with
// which it came: a form sends that of the page.
document.addEventListener("htmx:configRequest", ({ detail }) => {
  if (detail.target.id !== "main") return;
  const parts = [...document.querySelectorAll("[data-part]")].map((one) => `${one.id}=${one.dataset.part}`).join(" ");
  if (parts.length < 7000) detail.headers["X-Parts"] = parts; // servers refuse longer headers
  const seen = document.querySelector("#seen")?.value;
  if (seen && detail.formData.has("seen")) detail.formData.set("seen", seen);
});

// What is typed and not sent goes back into a part that is replaced, also after another page. A row is known by its experiment,
// whose number may have changed. What is unfolded stays so, but an answer for several rows lets their group fold.
const left = new Map(); // by page: what was typed there, and what was unfolded
let sent = new WeakMap(); // by field: its state when it was last sent
let before = "", typing = null, rows = [];
const heading = () => document.querySelector("h1").textContent;
const switched = (one) => one.type === "checkbox" || one.type === "radio";
const state = (one) => (switched(one) ? one.checked : one.value);
const shown = (one) => {
  if (switched(one)) return one.defaultChecked;
  if (one.tagName !== "SELECT") return one.defaultValue;
  return ([...one.options].find((option) => option.defaultSelected) ?? one.options[0])?.value;
};
const unsaved = (one) => state(one) !== (sent.has(one) ? sent.get(one) : shown(one));
const key = (one) =>
  [one.form?.dataset.row ?? one.form?.id, one.name.replace(/^experiments\.\d+/, ""), switched(one) && one.value].join("\n");
const typed = (within) => [...within.querySelectorAll("input:not([type=hidden], [type=file]), select, textarea")].filter((one) => one.name);
const place = (one) => {
  const row = one.closest("[data-row]")?.dataset.row;
  return row === undefined ? one.id : [row, one.id.replace(/-\d+(?=-|$)/, "")].join("\n");
};
const around = (one) => (one ? [one, ...around(one.parentElement.closest("details"))] : []);
const unfold = (one) => around(one.closest("details")).forEach((folded) => (folded.open = true));
document.addEventListener("htmx:beforeSend", ({ detail }) => {
  const form = detail.elt.closest("form");
  if (form) for (const one of typed(form)) sent.set(one, state(one));
  if (waiting && form?.dataset.row === waiting.row && detail.requestConfig.formData.has(waiting.name)) waiting = null;
});
document.addEventListener("htmx:sendError", () => {
  sent = new WeakMap();
  document.querySelector("[role=status]").textContent = "No answer: the desk has stopped, or the upload is too large.";
});
document.addEventListener("htmx:beforeSwap", ({ detail }) => {
  if (detail.target.id !== "main") return;
  before = heading();
  const field = document.activeElement, folding = around(detail.requestConfig?.elt.closest(".together")?.closest("details"));
  typing = field.id && { place: place(field), at: field.selectionStart, to: field.selectionEnd };
  left.set(before, {
    typed: new Map(typed(detail.target).filter(unsaved).map((one) => [key(one), state(one)])),
    open: [...detail.target.querySelectorAll("details[id][open]")].filter((one) => !folding.includes(one)).map(place),
  });
});
document.addEventListener("htmx:afterSwap", ({ detail }) => {
  if (detail.target.id !== "main") return;
  const kept = left.get(heading()) ?? { typed: new Map(), open: [] };
  for (const one of detail.target.querySelectorAll("details[id]")) one.open ||= kept.open.includes(place(one));
  rows = [];
  for (const one of typed(detail.target)) {
    if (!kept.typed.has(key(one)) || unsaved(one)) continue;
    one[switched(one) ? "checked" : "value"] = kept.typed.get(key(one));
    unfold(one);
    if (one.form?.dataset.row) rows.push(one);
  }
  if (heading() !== before) return scrollTo(0, 0); // another page altogether
  const field = typing && [...detail.target.querySelectorAll("[id]")].find((one) => place(one) === typing.place);
  if (!field || field === document.activeElement) return;
  unfold(field); // the row may now be among the understood ones
  field.focus();
  if (typing.at != null) field.setSelectionRange(typing.at, typing.to);
});
// A row saves itself when a field is left: also if the answer to an earlier change was on the way then.
const changed = new Set();
// A button of the row that leaves the field sends the field too. Until it is released, the row must not be replaced under it.
let pressed = null, held = null;
document.addEventListener("pointerdown", (event) => (pressed = event.target.closest?.("[data-row] button")?.form), true);
document.addEventListener("change", (event) => {
  if (!pressed || event.target.form !== pressed) return changed.add(key(event.target));
  event.stopPropagation();
  held = event.target;
}, true);
for (const release of ["pointerup", "pointercancel"]) document.addEventListener(release, () => {
  const one = held;
  pressed = held = null;
  if (one) setTimeout(() => one.isConnected && unsaved(one) && one.dispatchEvent(new Event("change", { bubbles: true })));
}, true);
// A button of a row that is pressed while an earlier answer is on the way would be replaced before its turn: it is pressed again.
let waiting = null;
document.addEventListener("submit", ({ target, submitter }) => {
  const { row } = target.dataset;
  if (!row || !submitter?.name) return;
  const [form, name, value] = [row, submitter.name, submitter.value].map(CSS.escape);
  waiting = { row, name: submitter.name, button: `[data-row=${form}] [name=${name}][value=${value}]` };
}, true);
document.addEventListener("htmx:afterSettle", () => {
  const lost = waiting && document.querySelector(waiting.button);
  waiting = null;
  if (lost) return lost.click();
  const again = rows.splice(0).filter((one) => changed.has(key(one)) || one === document.activeElement);
  changed.clear();
  for (const one of again) {
    const save = () => one.isConnected && unsaved(one) && one.dispatchEvent(new Event("change", { bubbles: true }));
    if (one === document.activeElement) one.addEventListener("blur", save, { once: true });
    else save();
  }
});

// What is made of what is saved waits where something typed is not, nor on its way: what stands behind it says how to go on.
document.addEventListener("click", (event) => {
  const made = event.target.closest("[data-of-saved]");
  if (!made || !typed(document).some(unsaved)) return;
  event.preventDefault();
  event.stopPropagation();
  made.closest("p").nextElementSibling.hidden = false;
}, true);
