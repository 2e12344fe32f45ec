// Opens a GLB in three.js: the positions of some vertices at some times, and what went wrong.
const fs = require("fs");
const http = require("http");
const path = require("path");
const {chromium} = require("playwright-core");
const job = JSON.parse(process.argv[2]);
const three = path.join(path.dirname(require.resolve("three")), "..");

const page = `<!doctype html><link rel="icon" href="data:,"><script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import {GLTFLoader} from "/three/examples/jsm/loaders/GLTFLoader.js";
const gltf = await new GLTFLoader().loadAsync("/face.glb");
const mesh = gltf.scene.getObjectByProperty("isMesh", true);
const mixer = new THREE.AnimationMixer(gltf.scene);
const clip = gltf.animations[0];
mixer.clipAction(clip).play();
const renderer = new THREE.WebGLRenderer();
const camera = new THREE.PerspectiveCamera(30, 2, 0.01, 10);
camera.position.z = 0.6;
gltf.scene.add(new THREE.HemisphereLight());
const positions = ${JSON.stringify(job.times)}.map(time => {
  mixer.setTime(time);
  renderer.render(gltf.scene, camera);
  return ${JSON.stringify(job.vertices)}.map(i => mesh.getVertexPosition(i, new THREE.Vector3()).toArray());
});
window.answer = {positions, duration: clip.duration, meshes: gltf.scene.children.length};
</script>`;

const server = http.createServer((request, response) => {
  const kind = request.url.endsWith(".js") ? "text/javascript" : request.url === "/" ? "text/html" : "model/gltf-binary";
  response.setHeader("content-type", kind);
  if (request.url === "/") response.end(page);
  else if (request.url === "/face.glb") response.end(fs.readFileSync(job.file));
  else response.end(fs.readFileSync(path.join(three, request.url.replace("/three/", ""))));
});

server.listen(0, "127.0.0.1", async () => {
  const browser = await chromium.launch({executablePath: job.chromium, args: job.flags});
  const tab = await browser.newPage();
  const errors = [];
  tab.on("console", message => message.type() === "error" && errors.push(message.text()));
  tab.on("pageerror", error => errors.push(error.message));
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  await tab.waitForFunction(() => window.answer, null, {timeout: 30000}).catch(error => errors.push(error.message));
  console.log(JSON.stringify({...await tab.evaluate(() => window.answer), errors}));
  await browser.close();
  server.close();
});
