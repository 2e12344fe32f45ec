// Opens a page of ours from disk and uses it; screenshots go to the given folder.
const {chromium} = require("playwright-core");
const job = JSON.parse(process.argv[2]);

(async () => {
  const browser = await chromium.launch({executablePath: job.chromium, args: job.flags});
  const context = await browser.newContext({viewport: {width: 480, height: 600}, reducedMotion: "reduce"});
  const tab = await context.newPage();
  const errors = [], requests = [];
  tab.on("console", message => errors.push(message.text()));
  tab.on("pageerror", error => errors.push(error.message));
  tab.on("request", request => request.url().startsWith("http") && requests.push(request.url()));
  const shot = async name => {
    await tab.waitForTimeout(250);
    await tab.locator("canvas").screenshot({path: `${job.folder}/${name}.png`});
  };
  await tab.goto(`file://${job.file}`);
  await tab.waitForFunction(() => document.getElementById("count").textContent);
  await shot("start");
  await tab.fill("#time", String(job.last));
  await shot("end");
  const caption = await tab.textContent("#caption");
  await tab.keyboard.press("Home");
  await tab.keyboard.press("l");
  await shot("landmarks");
  await tab.keyboard.press("l");
  await tab.keyboard.press("w");
  await shot("wire");
  await tab.keyboard.press("w");
  await tab.mouse.move(240, 250);
  await tab.mouse.down();
  await tab.mouse.move(320, 250, {steps: 3});
  await tab.mouse.up();
  await shot("turned");
  await tab.click("#reset");
  await shot("again");
  await tab.click("#play");
  await tab.waitForTimeout(400);
  const playing = await tab.getAttribute("#play", "aria-label");
  const count = await tab.textContent("#count");
  console.log(JSON.stringify({
    errors, requests, caption, playing, count, title: await tab.title(),
    failure: await tab.isVisible("#failure"), injected: await tab.evaluate(() => "stolen" in window),
  }));
  await browser.close();
})();
