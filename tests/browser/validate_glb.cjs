// Prints Khronos' verdict on each file: [{numErrors, numWarnings, messages}, ...].
const fs = require("fs");
const validator = require("gltf-validator");
(async () => {
  const verdicts = [];
  for (const file of JSON.parse(process.argv[2])) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {maxIssues: 20});
    verdicts.push(report.issues);
  }
  console.log(JSON.stringify(verdicts));
})();
