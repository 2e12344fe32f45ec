// Generates motions beside the page's thread, with ONNX Runtime; see generator.js for the messages.
import * as ort from "./onnxruntime/ort.wasm.min.mjs";
import {sampleNoise, timeline} from "./motion.js";

const CHUNK = 8;  // frames that are decoded at a time, after which they are shown
let model, sessions, face, newest = 0;

async function fetched(name) {
  const found = await fetch(new URL(name, import.meta.url));
  if (!found.ok) throw Error(`${name}: the server answered ${found.status}.`);
  return found;
}

async function load() {
  // Several threads need headers that static servers do not send.
  ort.env.wasm.numThreads = 1;
  ort.env.logLevel = "error";
  ort.env.wasm.wasmPaths = new URL("./onnxruntime/", import.meta.url).href;
  model = await (await fetched("model.json")).json();
  const open = async name => ort.InferenceSession.create(
    new Uint8Array(await (await fetched(name)).arrayBuffer()), {executionProviders: ["wasm"], logSeverityLevel: 3});
  sessions = {motion: await open("motion.onnx"), decoder: await open("decoder.onnx")};
  return model;
}

// The arrays of a prepared face, as tensors by name. `scales` stand for 16-bit whole numbers with a scale for each row.
async function loadFace(index) {
  const bytes = await (await fetched(model.faces[index].file)).arrayBuffer(), tensors = {};
  let extras;
  for (const {name, shape, offset, scales} of model.arrays) {
    const count = shape.reduce((a, b) => a * b, 1);
    let values;
    if (scales === undefined) values = new Float32Array(bytes, offset, count);
    else {
      const whole = new Int16Array(bytes, offset, count), scale = new Float32Array(bytes, scales, shape[0]);
      const width = count / shape[0];
      values = new Float32Array(count);
      for (let i = 0; i < count; i++) values[i] = whole[i] * scale[Math.floor(i / width)];
    }
    if (name === "extras") extras = values;
    else tensors[name] = new ort.Tensor("float32", values, shape);
  }
  face = {index, tensors, extras};
}

async function generate(id, job) {
  newest = id;
  if (!face || face.index !== job.face) await loadFace(job.face);
  if (newest !== id) return;
  postMessage({id, kind: "face", extras: face.extras});
  const transitions = job.labels.length - 1, lengths = job.frames ?? Array(transitions).fill(model.drawn);
  const noise = job.noise ?? sampleNoise(job.seed, transitions, model.noise);
  const matrix = timeline(lengths, model.drawn), frames = matrix.length / (transitions * model.drawn);
  const float = (values, shape) => new ort.Tensor("float32", Float32Array.from(values), shape);
  const begin = performance.now();
  // A batch of one motion.
  const {landmarks} = await sessions.motion.run({
    choice: float([noise.choice], [1]),
    blur: float(noise.blur, [1, model.noise.blur]),
    noise: float(noise.transitions, [1, transitions, model.noise.noise]),
    labels: new ort.Tensor("int32", Int32Array.from(job.labels), [1, transitions + 1]),
    timeline: float(matrix, [frames, transitions * model.drawn]),
    rest: face.tensors.rest,
    size: face.tensors.size,
    intensity: float([job.intensity], [1]),
  });
  const motion = performance.now() - begin, points = landmarks.data, width = points.length / frames;
  const known = {...face.tensors};
  delete known.size;
  let decoding = 0;
  for (let first = 0; first < frames; first += CHUNK) {
    // Messages that came meanwhile are read here; a newer job ends this one.
    await new Promise(resolve => setTimeout(resolve));
    if (newest !== id) return;
    const count = Math.min(CHUNK, frames - first), start = performance.now();
    const part = new ort.Tensor("float32", points.slice(first * width, (first + count) * width), [count, ...landmarks.dims.slice(2)]);
    const {vertices} = await sessions.decoder.run({...known, landmarks: part});
    decoding += performance.now() - start;
    const data = Float32Array.from(vertices.data);
    postMessage({id, kind: "frames", first, count, frames, vertices: data}, [data.buffer]);
  }
  postMessage({id, kind: "done", frames, motion, decoding});
}

// One message after another: ONNX Runtime runs one session at a time. `newest` is set at once.
let queue = Promise.resolve();
onmessage = ({data: {id, job}}) => {
  newest = id;
  queue = queue
    .then(async () => {
      if (job === undefined) postMessage({id, kind: "ready", model: await load()});
      else if (newest === id) await generate(id, job);
    })
    .catch(error => postMessage({id, kind: "failed", message: error.message}));
};
