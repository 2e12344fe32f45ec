// Generates motions of a face in the visitor's browser, in a worker.
//
//   const generator = new Generator();
//   const model = await generator.load();
//   const {vertices, frames} = await generator.generate({labels: [0, 4, 0], seed: 1, face: 0, intensity: 1});
//
// A newer call ends an older one, whose promise is resolved with null.
export class Generator {
  constructor() {
    this.worker = new Worker(new URL("worker.js", import.meta.url), {type: "module"});
    this.worker.onmessage = ({data}) => this.#receive(data);
    this.worker.onerror = event => this.#fail(event.message || "The worker did not start.");
    this.id = 0;
    this.jobs = new Map();
  }

  // Returns the model: labels, faces, arrays, triangles and view.
  load() { return this.#send(undefined, {}); }

  // Returns {vertices: Float32Array of frames x vertices x 3 in mm, frames, motion, decoding: ms of both parts}.
  //
  // labels: two or more indices, no two in a row alike. seed: a whole number; or noise: {choice, blur, transitions}.
  // face: index into model.faces. intensity: 0 to 2. frames: of each transition. onFrames({vertices, extras, frames,
  // first, made}) is called whenever more frames have been made: `vertices` has room for all, and holds the first
  // `made`; `extras` are the eyes and teeth of the face at rest.
  generate({labels, seed = 0, noise, face = 0, intensity = 1, frames, onFrames}) {
    for (const [id, job] of this.jobs) if (job.kind !== "load") { job.resolve(null); this.jobs.delete(id); }
    return this.#send({labels, seed, noise, face, intensity, frames}, {onFrames});
  }

  #send(job, options) {
    const id = ++this.id;
    return new Promise((resolve, reject) => {
      this.jobs.set(id, {...options, kind: job === undefined ? "load" : "motion", resolve, reject});
      this.worker.postMessage({id, job});
    });
  }

  #receive(data) {
    const job = this.jobs.get(data.id);
    if (!job) return;
    if (data.kind === "face") { job.extras = data.extras; return; }
    if (data.kind === "frames") {
      const width = data.vertices.length / data.count;
      job.vertices ??= new Float32Array(width * data.frames);
      job.vertices.set(data.vertices, data.first * width);
      job.onFrames?.({vertices: job.vertices, extras: job.extras, frames: data.frames, first: data.first, made: data.first + data.count});
      return;
    }
    this.jobs.delete(data.id);
    if (data.kind === "ready") job.resolve(data.model);
    else if (data.kind === "done") job.resolve({vertices: job.vertices, frames: data.frames, motion: data.motion, decoding: data.decoding});
    else job.reject(Error(data.message));
  }

  #fail(message) {
    for (const job of this.jobs.values()) job.reject(Error(message));
    this.jobs.clear();
  }
}
