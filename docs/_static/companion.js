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

// Claims: a button for each verdict of ours shows the claims that have it, with their statements.
addEventListener("DOMContentLoaded", () => {
  const counts = document.querySelector('[id^="claims-of-"] > :not(section) table, [id^="claims-of-"] > table');
  if (!counts) return;
  const claims = [];
  for (const row of document.querySelectorAll('[id^="claims-of-"] section:not(#records-and-commands) tbody tr')) {
    const verdict = row.cells[1].querySelector("strong");
    if (row.cells[0].querySelector("strong")) claims.push({ verdict: verdict.textContent.replace(/^\W+/, ""), rows: [] });
    claims.at(-1).rows.push(row);
  }
  const bar = document.createElement("p");
  const names = ["all", ...new Set([...counts.querySelectorAll("tbody tr")].map((row) => row.cells[0].textContent.trim()))];
  for (const name of names.filter((one) => one === "all" || claims.some((claim) => claim.verdict === one))) {
    const button = document.createElement("button");
    button.className = "btn btn-sm btn-outline-primary me-1 mb-1";
    button.textContent = name;
    button.setAttribute("aria-pressed", name === "all");
    button.addEventListener("click", () => {
      for (const other of bar.children) other.setAttribute("aria-pressed", other === button);
      for (const { verdict, rows } of claims) for (const row of rows) row.hidden = name !== "all" && name !== verdict;
    });
    bar.append(button);
  }
  bar.className = "verdicts";
  bar.prepend("Ours: ");
  counts.after(bar);
});

// A cell of the results knows its column's name; a column "1 step" stands beside that of its model, "CAMDM, 8 steps".
addEventListener("DOMContentLoaded", () => {
  for (const table of document.querySelectorAll("#what-was-measured table")) {
    const names = [...table.querySelectorAll("thead th")].map((cell) => cell.textContent.trim());
    names.forEach((name, k) => { if (/^\d+ step/.test(name)) names[k] = `${names[k - 1].split(",")[0]}, ${name}`; });
    for (const cell of table.querySelectorAll("td")) cell.dataset.label = names[cell.cellIndex];
  }
});

// One switch hides the code of notebooks, and stays as it was set.
addEventListener("DOMContentLoaded", () => {
  const title = document.querySelector(".bd-article h1");
  if (!title || !document.querySelector(".bd-article .cell_input")) return;
  const button = Object.assign(document.createElement("button"), { className: "hide-code", type: "button" });
  const set = (hidden) => {
    document.documentElement.toggleAttribute("data-no-code", hidden);
    button.textContent = hidden ? "Show all code" : "Hide all code";
    localStorage.setItem("no-code", hidden ? "yes" : "");
  };
  set(localStorage.getItem("no-code") === "yes");
  button.addEventListener("click", () => set(!document.documentElement.hasAttribute("data-no-code")));
  title.after(button);
});

// Code is copied by a button.
addEventListener("DOMContentLoaded", () => {
  if (!navigator.clipboard) return;
  for (const block of document.querySelectorAll(".bd-article div.highlight")) {
    if (block.closest(".cell_output")) continue;
    const button = Object.assign(document.createElement("button"), { className: "copy", type: "button", textContent: "Copy" });
    button.addEventListener("click", async () => {
      await navigator.clipboard.writeText(block.querySelector("pre").textContent);
      button.textContent = "Copied";
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
    });
    block.append(button);
  }
});

// Tables: names may break after an underscore or a slash.
addEventListener("DOMContentLoaded", () => {
  for (const table of document.querySelectorAll(".bd-article table")) {
    const names = [...table.querySelectorAll("thead th")];
    for (const cell of table.querySelectorAll("th, td")) {
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
