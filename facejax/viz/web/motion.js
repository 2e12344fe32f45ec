// What a motion is generated from, as in `facejax.inference.composition`: random numbers and the joining matrix.

const REACH = 8;  // frames on each side of a joint over which its correction decays

// Random numbers of a seed: xoshiro128** (Blackman and Vigna 2018) of 32 bits, whose state is filled by SplitMix32;
// standard normal ones by the method of Box and Muller, two at a time.
export class Random {
  constructor(seed) {
    let state = seed >>> 0;
    this.state = Array.from({length: 4}, () => {
      state = (state + 0x9e3779b9) >>> 0;
      let z = state;
      z = Math.imul(z ^ (z >>> 16), 0x85ebca6b);
      z = Math.imul(z ^ (z >>> 13), 0xc2b2ae35);
      return (z ^ (z >>> 16)) >>> 0;
    });
    this.spare = null;
  }

  // A whole number in [0, 2^32).
  integer() {
    const s = this.state, turn = (x, k) => (x << k) | (x >>> (32 - k));
    const result = Math.imul(turn(Math.imul(s[1], 5), 7), 9) >>> 0, shifted = s[1] << 9;
    s[2] ^= s[0]; s[3] ^= s[1]; s[1] ^= s[2]; s[0] ^= s[3];
    s[2] ^= shifted;
    s[3] = turn(s[3], 11);
    return result;
  }

  // A number in [0, 1).
  uniform() { return this.integer() / 2 ** 32; }

  normal() {
    if (this.spare !== null) { const found = this.spare; this.spare = null; return found; }
    const radius = Math.sqrt(-2 * Math.log((this.integer() + 1) / 2 ** 32)), angle = 2 * Math.PI * this.uniform();
    this.spare = radius * Math.sin(angle);
    return radius * Math.cos(angle);
  }
}

// The noise of one motion: `choice` in [0, 1), `blur` (D) and `transitions` (P times n) standard normal.
export function sampleNoise(seed, transitions, sizes) {
  const random = new Random(seed);
  const normal = count => Float32Array.from({length: count}, () => random.normal());
  return {choice: random.uniform(), blur: normal(sizes.blur), transitions: normal(transitions * sizes.noise)};
}

// The matrix (F, P T), row by row, that joins P transitions of `drawn` frames on one timeline of F frames; `frames` has
// the frames of each transition. See `composition.timeline`.
export function timeline(frames, drawn, reach = REACH) {
  if (!frames.length || Math.min(...frames) < 2 || drawn < 2) throw Error("A transition has 2 frames or more.");
  const ends = [0];
  for (const count of frames) ends.push(ends[ends.length - 1] + count - 1);
  const width = frames.length * drawn, rows = ends[ends.length - 1] + 1, matrix = new Float64Array(rows * width);
  frames.forEach((count, i) => {
    // At the joint both transitions agree: the later one is used.
    matrix.fill(0, ends[i] * width, (ends[i + 1] + 1) * width);
    const cubic = cubicRows(count, drawn);
    for (let row = 0; row < count; row++) {
      matrix.set(cubic.subarray(row * drawn, (row + 1) * drawn), (ends[i] + row) * width + i * drawn);
    }
  });
  for (let i = frames.length - 2; i >= 0; i--) {
    const joint = ends[i + 1], bend = new Float64Array(width);
    for (let k = 0; k < width; k++) {
      bend[k] = matrix[(joint + 1) * width + k] - 2 * matrix[joint * width + k] + matrix[(joint - 1) * width + k];
    }
    const last = joint === ends[ends.length - 2];
    const sides = [
      [-1, Math.min(reach, Math.floor((frames[i] - 1) / 2))],
      [1, Math.min(reach, Math.floor((frames[i + 1] - (last ? 1 : 2)) / 2))],
    ].filter(([, size]) => size);
    for (const [sign, size] of sides) {
      for (let step = 1; step <= size; step++) {
        const decay = step * ((size + 1 - step) / size) ** 2 / sides.length, row = (joint + sign * step) * width;
        for (let k = 0; k < width; k++) matrix[row + k] -= decay * bend[k];
      }
    }
  }
  return Float32Array.from(matrix);
}

// Catmull-Rom interpolation (count, drawn) at equidistant times; ends by linear extrapolation.
function cubicRows(count, drawn) {
  const rows = new Float64Array(count * drawn);
  for (let row = 0; row < count; row++) {
    const place = row * (drawn - 1) / (count - 1), low = Math.min(Math.floor(place), drawn - 2), x = place - low;
    const weights = [-x + 2 * x ** 2 - x ** 3, 2 - 5 * x ** 2 + 3 * x ** 3, x + 4 * x ** 2 - 3 * x ** 3, x ** 3 - x ** 2];
    const add = (frame, weight) => { rows[row * drawn + frame] += weight; };
    weights.forEach((twice, k) => {
      const frame = low + k - 1, weight = twice / 2;
      // A frame before the first is 2 x0 - x1; after the last likewise.
      if (frame < 0) { add(0, 2 * weight); add(1, -weight); }
      else if (frame >= drawn) { add(drawn - 1, 2 * weight); add(drawn - 2, -weight); }
      else add(frame, weight);
    });
  }
  return rows;
}

// The rigid motion that takes points (3 numbers each) closest to others: {rotation: 3 rows, from, to: the two centres}.
// The rotation is the quaternion of Horn 1987, the leading eigenvector of a 4 x 4 matrix, by repeated squaring.
export function rigidFit(source, target) {
  const count = source.length / 3, centre = points => [0, 1, 2].map(axis => {
    let sum = 0;
    for (let i = axis; i < points.length; i += 3) sum += points[i];
    return sum / count;
  });
  const from = centre(source), to = centre(target), s = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < source.length; i += 3) {
    for (let a = 0; a < 3; a++) for (let b = 0; b < 3; b++) s[a][b] += (source[i + a] - from[a]) * (target[i + b] - to[b]);
  }
  const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s;
  const matrix = [
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ];
  // Shifted so that the largest eigenvalue is also the largest in size.
  const shift = Math.max(...matrix.map(row => row.reduce((sum, x) => sum + Math.abs(x), 0))) || 1;
  let power = matrix.map((row, i) => row.map((x, k) => (x + (i === k ? shift : 0)) / (2 * shift)));
  for (let step = 0; step < 16; step++) {
    const next = power.map(row => row.map((_, k) => row.reduce((sum, x, i) => sum + x * power[i][k], 0)));
    const size = Math.max(...next.flat().map(Math.abs));
    power = next.map(row => row.map(x => x / size));
  }
  // Every column is a multiple of the eigenvector; the one with the largest diagonal entry is the most accurate.
  const column = [0, 1, 2, 3].reduce((best, k) => power[k][k] > power[best][best] ? k : best);
  const length = Math.hypot(...power.map(row => row[column])), q = power.map(row => row[column] / length);
  const [w, x, y, z] = q;
  const rotation = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  return {rotation, from, to};
}
