// What the desk needs besides htmx: stages of long work as they come, and a place for dropped files.
"use strict";
htmx.onLoad(() => {
  const shown = document.querySelector("[data-events]");
  if (shown && !shown.dataset.heard) {
    shown.dataset.heard = "yes";
    const news = new EventSource(shown.dataset.events);
    const end = () => {
      news.close();
      if (shown.isConnected)
        htmx.ajax("GET", location.pathname, { target: "#main", select: "#main > *", swap: "innerHTML show:none" });
    };
    news.addEventListener("stage", (event) => {
      if (!shown.isConnected) return news.close();
      shown.querySelector("span").textContent = event.data;
    });
    news.addEventListener("end", end);
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
  const said = document.querySelector("[role=status]");
  said.textContent = "No answer: the desk was ended, or this was more than it takes at once.";
});
