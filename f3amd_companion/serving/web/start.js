// Unpacks what a page carries, tells the browser the modules' names and starts the page's own; `player.whole_page`.
(async () => {
  const { nonce } = document.currentScript, script = document.getElementById("packed"), packed = JSON.parse(script.textContent);
  script.remove();
  const unpack = async (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  };
  const imports = {}, files = {};
  for (const [name, text] of Object.entries(packed.modules))
    imports[name] = URL.createObjectURL(new Blob([await unpack(text)], { type: "text/javascript" }));
  for (const [name, text] of Object.entries(packed.files)) files[name] = new Uint8Array(await unpack(text));
  const map = document.createElement("script");
  Object.assign(map, { nonce, type: "importmap", textContent: JSON.stringify({ imports }) });
  document.head.append(map);
  const { start } = await import(packed.start);
  await start(files, unpack);
})().catch((error) => {
  const message = document.getElementById("message");
  message.textContent = `This page cannot be shown here: ${error.message}. It needs a browser of 2023 or later with WebGL; ` +
    "where one allows no workers to a file, serve the folder: python -m http.server";
  message.hidden = false;
});
