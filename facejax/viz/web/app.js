// The page: labels, face, intensity and seed in; a head that moves out.
import {createDrawing} from "./drawing.js";
import {Generator} from "./generator.js";
import {rigidFit} from "./motion.js";

const $ = id => document.getElementById(id);
const FPS = 30, canvas = $("view");
const title = name => name.replaceAll("_", " ");

function decode(text, Kind) { return new Kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer); }

async function main() {
  const generator = new Generator(), model = await generator.load();
  const surface = decode(model.surface, Uint8Array);
  let dirty = true;
  const space = () => ({top: $("caption").getBoundingClientRect().bottom, bottom: canvas.getBoundingClientRect().bottom - 12});
  const drawing = createDrawing(canvas, model.view, decode(model.triangles, Uint32Array), surface, space, () => dirty = true);

  let sequence = model.start, shown = null, extras = null, face = 0, made = 0, frames = 0, frame = 0, playing = true, last = 0, at = -1, spoken = "";
  let stamps = [], drawn = 0;

  function show(now, index) {
    [shown, extras, face, frames, made, at] = [now.vertices, now.extras, index, now.frames, now.made, -1];
    frame = Math.min(frame, frames - 1);
    $("time").max = frames - 1;
    dirty = true;
  }

  async function generate() {
    $("strength").textContent = Number($("intensity").value).toFixed(2);
    const begin = performance.now(), index = $("face").selectedIndex;
    try {
      const done = await generator.generate({
        labels: sequence, seed: $("seed").valueAsNumber >>> 0, face: index,
        intensity: $("intensity").valueAsNumber, onFrames: now => show(now, index),
      });
      if (!done) return;
      const total = performance.now() - begin;
      spoken = `${done.frames} frames generated in ${Math.round(total)} ms (${Math.round(1000 * done.frames / total)} per second): ` +
        `motion ${Math.round(done.motion)} ms, vertices ${Math.round(done.decoding)} ms`;
    } catch (error) { fail(error.message); }
  }

  function listSequence() {
    $("sequence").replaceChildren(...sequence.map((label, i) => {
      const item = document.createElement("li"), button = document.createElement("button");
      button.textContent = title(model.labels[label]) + (sequence.length > 2 ? " ×" : "");
      button.title = "Remove";
      button.disabled = sequence.length < 3;
      button.onclick = () => {
        const rest = sequence.filter((_, k) => k !== i);
        // No label may follow itself.
        choose(rest.filter((one, k) => one !== rest[k - 1]));
      };
      item.append(button);
      return item;
    }));
    [...$("labels").children].forEach((button, i) => { button.disabled = i === sequence[sequence.length - 1]; });
  }

  function choose(labels) {
    if (labels.length < 2) labels = [labels[0], labels[0] === 0 ? 1 : 0];
    sequence = labels;
    frame = 0;
    listSequence();
    generate();
  }

  $("labels").replaceChildren(...model.labels.map((name, i) => {
    const button = document.createElement("button");
    button.textContent = title(name);
    button.onclick = () => choose(sequence.concat(i));
    return button;
  }));
  $("face").replaceChildren(...model.faces.map(({name}) => new Option(name)));
  $("clear").onclick = () => choose(sequence.slice(0, 2));
  $("noise").onclick = () => { $("seed").value = crypto.getRandomValues(new Uint32Array(1))[0] % 1000000; generate(); };
  $("seed").onchange = $("face").onchange = $("intensity").oninput = generate;
  $("reset").onclick = drawing.resetView;
  $("time").oninput = () => { setPlaying(false); frame = Math.min($("time").valueAsNumber, made - 1); dirty = true; };
  $("play").onclick = () => setPlaying(!playing);
  addEventListener("keydown", event => {
    if (event.key !== " " || ["BUTTON", "INPUT", "SELECT"].includes(event.target.tagName)) return;
    event.preventDefault();
    setPlaying(!playing);
  });

  function setPlaying(on) {
    playing = on;
    last = performance.now();
    $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    $("play").querySelector("path").setAttribute("d", playing ? "M3 2h4v12H3zM9 2h4v12H9z" : "M4 2l10 6-10 6z");
  }

  function pose(low, high, part) {
    const stride = 3 * model.view.face, positions = drawing.positions;
    for (let i = 0; i < stride; i++) {
      const a = shown[low * stride + i];
      positions[i] = a + part * (shown[high * stride + i] - a);
    }
    positions.set(extras, stride);
    // The lower teeth move with the landmarks of the jaw.
    const {jaw, teeth} = model.lower;
    if (!jaw.length) return;
    const moved = jaw.flatMap(v => [...positions.subarray(3 * v, 3 * v + 3)]);
    const {rotation, from, to} = rigidFit(model.faces[face].jaw, moved);
    for (let i = 3 * teeth[0]; i < 3 * teeth[1]; i += 3) {
      const arm = [positions[i] - from[0], positions[i + 1] - from[1], positions[i + 2] - from[2]];
      for (let axis = 0; axis < 3; axis++) {
        const [x, y, z] = rotation[axis];
        positions[i + axis] = to[axis] + x * arm[0] + y * arm[1] + z * arm[2];
      }
    }
  }

  function label(current) {
    $("time").value = current;
    // Every transition has as many frames as are drawn, and shares its last one with the next.
    const part = Math.min(Math.floor(current / (model.drawn - 1)), sequence.length - 2);
    $("caption").textContent = `${title(model.labels[sequence[part]])} → ${title(model.labels[sequence[part + 1]])}`;
    [...$("sequence").children].forEach((item, i) => i === part + 1 ? item.setAttribute("aria-current", "step") : item.removeAttribute("aria-current"));
  }

  function tick(now) {
    if (playing && shown) {
      frame += (now - last) / 1000 * FPS;
      // A short rest on the last frame, then from the start; frames that are not made yet are waited for.
      if (frame > frames - 1 + 0.4 * FPS && made === frames) frame = 0;
      dirty = true;
    }
    last = now;
    if (dirty && shown) {
      const current = Math.min(frame, made - 1), low = Math.floor(current), high = Math.min(low + 1, made - 1), part = current - low;
      if (playing && made < frames) frame = Math.min(frame, made);
      if (at !== current) {
        pose(low, high, part);
        drawing.update();
        label(low);
        at = current;
      }
      drawing.draw();
      dirty = false;
      drawn++;
      stamps.push(now);
      stamps = stamps.filter(stamp => stamp > now - 1000);
    }
    if (spoken) $("readout").textContent = `${spoken}\n${stamps.length} frames drawn per second`;
    requestAnimationFrame(tick);
  }

  new ResizeObserver(() => dirty = true).observe(canvas);
  canvas.addEventListener("webglcontextlost", () => fail("The graphics context was lost: reload the page."));
  setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  listSequence();
  await generate();
  $("failure").hidden = true;
  // For scripts of the page and for tests.
  window.facejax = {generator, model, drawnPerSecond: () => stamps.length};
  requestAnimationFrame(tick);
}

function fail(message) { $("failure").textContent = message; $("failure").hidden = false; }
main().catch(error => { fail(error.message); throw error; });
