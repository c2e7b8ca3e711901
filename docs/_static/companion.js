// A page opened from a disk may not read its neighbours: search then lists titles without excerpts.
if (location.protocol === "file:" && typeof DOCUMENTATION_OPTIONS !== "undefined") {
  DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = false;
}

// Who asked for less motion sees the first picture of an animation; following it plays it.
addEventListener("DOMContentLoaded", () => {
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  for (const image of document.querySelectorAll("img.moving")) {
    image.loading = "eager";
    image.decode().then(() => {
      const still = document.createElement("canvas");
      still.width = image.naturalWidth;
      still.height = image.naturalHeight;
      still.getContext("2d").drawImage(image, 0, 0);
      still.className = image.className;
      still.setAttribute("role", "img");
      still.setAttribute("aria-label", image.alt);
      image.replaceWith(still);
    });
  }
});

// Tables: names may break after an underscore or a slash, and a cell of the claims knows its column's name.
addEventListener("DOMContentLoaded", () => {
  for (const table of document.querySelectorAll(".bd-article table")) {
    const names = [...table.querySelectorAll("thead th")].map((cell) => cell.textContent.trim());
    for (const cell of table.querySelectorAll("th, td")) {
      if (cell.matches("[id^=\"claims-of-\"] td") && names[cell.cellIndex]) {
        cell.dataset.label = names[cell.cellIndex];
        if (["", "–"].includes(cell.textContent.trim())) cell.dataset.empty = "";
      }
      const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
      const texts = [];
      while (walker.nextNode()) texts.push(walker.currentNode);
      // An interval stays whole, unless there are so many columns that it would push the last ones out.
      if (names.length < 10) for (const text of texts) text.data = text.data.replaceAll("± ", "±\u00a0");
      for (const text of texts.filter((node) => /[_/]\w/.test(node.data) && !node.parentElement.closest(".math"))) {
        const pieces = text.data.split(/(?<=[_/])(?=\w)/).flatMap((piece) => [piece, document.createElement("wbr")]);
        text.replaceWith(...pieces.slice(0, -1));
      }
    }
  }
});
