// Opens the page of `facejax.export.web` on a server, generates a motion of given noise, and times some of a seed.
const fs = require("fs");
const {chromium} = require("playwright-core");
const job = JSON.parse(process.argv[2]);

(async () => {
  const browser = await chromium.launch({executablePath: job.chromium, args: job.flags});
  const tab = await (await browser.newContext({viewport: {width: job.width ?? 1280, height: 800}})).newPage();
  const errors = [], requests = [];
  tab.on("console", message => message.type() === "error" && errors.push(message.text()));
  tab.on("pageerror", error => errors.push(error.message));
  tab.on("request", request => requests.push(request.url()));
  await tab.goto(job.url);
  await tab.waitForFunction(() => window.facejax || !document.getElementById("failure").textContent.startsWith("Loading"));
  const failure = await tab.isVisible("#failure") ? await tab.textContent("#failure") : "";
  const found = [];
  for (const motion of job.motions) {
    const base64 = await tab.evaluate(async motion => {
      const {vertices} = await window.facejax.generator.generate(motion);
      const bytes = new Uint8Array(vertices.buffer);
      let text = "";
      for (let i = 0; i < bytes.length; i += 30000) text += String.fromCharCode(...bytes.subarray(i, i + 30000));
      return btoa(text);
    }, motion);
    found.push(`${job.folder}/motion${found.length}.bin`);
    fs.writeFileSync(found[found.length - 1], Buffer.from(base64, "base64"));
  }
  const before = await tab.textContent("#readout");
  await tab.click("#labels button:nth-child(2)");
  const ready = text => document.getElementById("readout").textContent.startsWith(text);
  await tab.waitForFunction(ready, `${job.frames} frames`);
  await tab.click("#noise");
  await tab.waitForTimeout(job.wait ?? 100);
  await tab.waitForFunction(ready, `${job.frames} frames`);
  const readout = await tab.textContent("#readout"), sequence = await tab.locator("#sequence li").count();
  await tab.click("#play");
  const paused = await tab.getAttribute("#play", "aria-label");
  await tab.screenshot({path: `${job.folder}/page.png`});
  console.log(JSON.stringify({errors, requests, failure, found, before, readout, sequence, paused}));
  await browser.close();
})();
