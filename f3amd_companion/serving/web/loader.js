// Unpack what the page carries, and start. A module that imports another gets its address, a blob's.
(async () => {
  const tell = (text) => {
    const message = document.getElementById("message");
    message.textContent = text;
    message.hidden = false;
  };
  try {
    const data = JSON.parse(document.getElementById("steer-data").textContent);
    const packed = JSON.parse(document.getElementById("steer-files").textContent);
    const unpack = async (name) => {
      const bytes = Uint8Array.from(atob(packed[name]), (letter) => letter.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
      return new Uint8Array(await new Response(stream).arrayBuffer());
    };
    const urls = {};
    for (const [name, specifier] of data.modules) {
      let text = new TextDecoder().decode(await unpack(name));
      for (const [known, url] of Object.entries(urls))
        text = text.replaceAll(`from "${known}"`, `from "${url}"`).replaceAll(`from '${known}'`, `from "${url}"`);
      urls[specifier] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
    }
    const worker = URL.createObjectURL(new Blob([await unpack("worker")], { type: "text/javascript" }));
    const files = {};
    for (const name of ["wasm", "program", "poses"]) files[name] = await unpack(name);
    document.getElementById("steer-files").remove();
    const { start } = await import(urls["./steer.js"]);
    window.steer = await start(data, files, worker);
  } catch (error) {
    tell(`This page cannot start here: ${error.message}. It needs WebGL, WebAssembly and workers. ` +
      "Where a browser allows no workers to a file, serve the folder: python -m http.server");
  }
})();
