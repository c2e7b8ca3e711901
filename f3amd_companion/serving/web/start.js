// Unpacks the modules of a page, tells the browser their names and starts one of them; `player.module_scripts`.
(async () => {
  const packed = JSON.parse(document.getElementById("modules").textContent);
  const imports = {};
  for (const [name, text] of Object.entries(packed.modules)) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const script = await new Response(stream).blob();
    imports[name] = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  await import(packed.start);
})().catch((error) => {
  const message = document.getElementById("message");
  message.textContent = `This page cannot start; it needs a browser of 2023 or later (${error.message}).`;
  message.hidden = false;
});
