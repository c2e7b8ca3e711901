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
