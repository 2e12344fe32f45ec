// Calls functions of motion.js, without a browser.
const fs = require("fs");
const job = JSON.parse(process.argv[2]);

(async () => {
  const text = fs.readFileSync(job.file, "utf8");
  const {Random, rigidFit, sampleNoise, timeline} = await import("data:text/javascript;base64," + Buffer.from(text).toString("base64"));
  const random = new Random(job.seed), whole = Array.from({length: 5}, () => random.integer());
  const {choice, blur, transitions} = sampleNoise(job.seed, 2, {blur: 10000, noise: 10000});
  console.log(JSON.stringify({
    timelines: job.timelines.map(({frames, drawn}) => [...timeline(frames, drawn)]),
    rigid: rigidFit(job.source, job.target),
    whole, choice, blur: [...blur], transitions: [...transitions],
  }));
})();
