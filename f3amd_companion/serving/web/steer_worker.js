// The network, in a worker: ONNX Runtime in WebAssembly on one thread, or by WebGPU, all characters in one call. The page
// sends what the player wishes, and gets frames back.
import * as ort from "onnxruntime-web";
import { advance, lockFrame, normalNumbers, sampleRound, startCharacter, startFeet } from "./motion.js";

let card, session, poses, characters = [], draw = normalNumbers(1);

async function denoise(x, sigma, { history, path, style }) {
  const batch = x.length / (card.window * card.channels);
  const tensor = (data, ...dims) => new ort.Tensor("float32", data, dims);
  const { x0_hat: clean } = await session.run({
    x_noisy: tensor(x, batch, card.window, card.channels),
    sigma: tensor(new Float32Array(batch).fill(sigma), batch),
    history: tensor(history, batch, card.num_history, card.channels),
    path: tensor(path, batch, card.window, 8),
    style: tensor(style, batch, card.styles.length),
  });
  return clean.data;
}

const frameList = (flat, channels) =>
  Array.from({ length: flat.length / channels }, (_, k) => flat.subarray(k * channels, (k + 1) * channels));

const answers = {
  async open(message) {
    if (!globalThis.WebAssembly) throw new Error("this browser has no WebAssembly, or it is switched off");
    ({ card } = message);
    poses = frameList(message.poses, card.num_history * card.channels).map((pose) => frameList(pose, card.channels));
    Object.assign(ort.env.wasm, { wasmBinary: message.wasm, numThreads: 1, proxy: false });
    const create = (provider) => ort.InferenceSession.create(message.program, {
      executionProviders: [provider], logSeverityLevel: 3, // that some nodes stay on the processor is no fault
    });
    if (card.webgpu) {
      try {
        const adapter = await self.navigator.gpu?.requestAdapter();
        if (!adapter) throw new Error("this browser lends no graphics card");
        const software = adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter ?? false;
        if (software && !message.software) throw new Error("this browser only plays a graphics card, in software");
        session = await create("webgpu");
        return { runs: software ? "software" : "webgpu" };
      } catch (error) {
        session = await create("wasm");
        return { runs: "wasm", instead: String(error?.message ?? error) };
      }
    }
    session = await create("wasm");
    return { runs: "wasm" };
  },
  // Characters that are there stay; new ones start at {x, z, yaw, style}. noise of a seed, for tests.
  characters({ places, seed, keep }) {
    if (seed !== undefined) draw = normalNumbers(seed);
    characters = places.map((place, k) => {
      if (keep && characters[k]) return characters[k];
      const character = startCharacter(poses[place.style], place.x, place.z, place.yaw);
      if (card.legs) character.feet = startFeet(card.skeleton, card.legs, character.history);
      return character;
    });
    return { histories: characters.map(({ history }) => history) };
  },
  // `shown` has the feet held, if they shall be; histories stay what the network made.
  async round({ wishes, styles, sigmas, hop, blend, noise, locking = false }) {
    const began = performance.now();
    const drawn = noise ?? draw(characters.length * card.window * card.channels);
    const made = await advance(card, characters, wishes, styles, denoise, drawn, sigmas, hop, blend);
    characters.forEach((character, k) => {
      made[k].shown = made[k].frames.map((frame) => {
        if (!character.feet) return frame;
        const settled = lockFrame(card.skeleton, card.legs, character.feet, frame, locking);
        character.feet = settled.feet;
        return settled.frame;
      });
    });
    return { made, targets: characters.map(({ target }) => target), ms: performance.now() - began };
  },
  // One window of a given condition, and how long it took.
  async sample({ condition, noise, sigmas }) {
    const began = performance.now();
    const clean = await sampleRound((x, sigma) => denoise(x, sigma, condition), noise, sigmas);
    return { clean, ms: performance.now() - began };
  },
};

self.onmessage = async ({ data: { id, kind, ...message } }) => {
  try {
    self.postMessage({ id, ...(await answers[kind](message)) });
  } catch (error) {
    self.postMessage({ id, error: String(error?.message ?? error) });
  }
};
