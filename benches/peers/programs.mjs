// Reads GLB files with three.js, Babylon.js and <model-viewer> in Chromium, for programs.py.
// Usage: programs.mjs FOLDER. Prints positions and colours of the vertices as JSON.
import { createServer } from "node:http";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const { MOLMESH_MODULES, MOLMESH_CHROMIUM } = process.env;
const { chromium } = createRequire(path.join(MOLMESH_MODULES, "x.js"))("playwright-core");
const folder = process.argv[2];
const PAGE = `<!doctype html><meta charset="utf-8">
<script type="importmap">{ "imports": { "three": "/three/build/three.module.js" } }</script>
<script src="/babylonjs/babylon.js"></script>
<script src="/babylonjs-loaders/babylonjs.loaders.min.js"></script>
<script>self.ModelViewerElement = { meshoptDecoderLocation: "/meshoptimizer/meshopt_decoder.cjs" };</script>
<script type="module" src="/@google/model-viewer/dist/model-viewer.min.js"></script>
<model-viewer style="width: 64px; height: 64px"></model-viewer>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "/three/examples/jsm/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "/three/examples/jsm/libs/meshopt_decoder.module.js";

/** Returns the vertices of a scene of three.js, in the coordinates of its parent: <model-viewer> moves the parent. */
function vertices(scene) {
  const [points, colors] = [[], []];
  scene.updateWorldMatrix(true, true);
  const toParent = scene.parent?.matrixWorld.clone().invert() ?? new THREE.Matrix4();
  scene.traverse(({ geometry, matrixWorld }) => {
    if (!geometry) return;
    const { position, color } = geometry.attributes;
    for (let i = 0; i < position.count; i += 1) {
      points.push(new THREE.Vector3().fromBufferAttribute(position, i).applyMatrix4(matrixWorld).applyMatrix4(toParent).toArray());
      if (color) colors.push([color.getX(i), color.getY(i), color.getZ(i)]);
    }
  });
  return { points, colors: colors.length ? colors : null };
}

BABYLON.MeshoptCompression.Configuration = { decoder: { url: "/meshoptimizer/meshopt_decoder.cjs" } };
window.readers = {
  "three.js": async (url) => vertices((await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).loadAsync(url)).scene),
  "Babylon.js": async (url) => {
    const scene = new BABYLON.Scene(new BABYLON.NullEngine());
    // glTF is right-handed.
    scene.useRightHandedSystem = true;
    await BABYLON.SceneLoader.AppendAsync("", url, scene);
    const [points, colors] = [[], []];
    for (const mesh of scene.meshes.filter((mesh) => mesh.getTotalVertices())) {
      const matrix = mesh.computeWorldMatrix(true);
      const buffer = (kind, size) => mesh.getVertexBuffer(kind)?.getFloatData(mesh.getTotalVertices(), true) ?? null;
      const [position, color] = [buffer("position"), buffer("color")];
      for (let i = 0; i < mesh.getTotalVertices(); i += 1) {
        points.push(BABYLON.Vector3.TransformCoordinates(BABYLON.Vector3.FromArray(position, 3 * i), matrix).asArray());
        if (color) colors.push([...color.slice(4 * i, 4 * i + 3)]);
      }
    }
    return { points, colors: colors.length ? colors : null };
  },
  "\`<model-viewer>\`": async (url) => {
    const viewer = document.querySelector("model-viewer");
    await new Promise((resolve, reject) => {
      viewer.addEventListener("load", resolve, { once: true });
      viewer.addEventListener("error", ({ detail }) => reject(new Error(JSON.stringify(detail))), { once: true });
      viewer.src = url;
    });
    const scene = viewer[Object.getOwnPropertySymbols(viewer).find((symbol) => symbol.description === "scene")];
    return vertices(scene.model);
  },
};
window.ready = true;
</script>`;

const server = createServer((request, reply) => {
  const name = new URL(request.url, "http://x").pathname;
  if (name === "/") return reply.writeHead(200, { "content-type": "text/html; charset=utf-8" }).end(PAGE);
  try {
    const bytes = readFileSync(name.endsWith(".glb") ? path.join(folder, path.basename(name)) : path.join(MOLMESH_MODULES, name));
    reply.writeHead(200, { "content-type": name.endsWith(".glb") ? "model/gltf-binary" : "text/javascript" }).end(bytes);
  } catch {
    reply.writeHead(404).end();
  }
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath: MOLMESH_CHROMIUM, args });
const page = await browser.newPage();
await page.goto(`http://127.0.0.1:${server.address().port}/`);
await page.waitForFunction(() => window.ready && customElements.get("model-viewer"), null, { timeout: 60_000 });
const found = {};
for (const program of await page.evaluate(() => Object.keys(window.readers))) {
  found[program] = {};
  for (const file of ["plain.glb", "quantized.glb", "meshopt.glb"])
    found[program][file] = await page.evaluate(([program, file]) => window.readers[program](`/${file}`).catch((error) => ({ error: String(error) })), [program, file]);
}
console.log(JSON.stringify(found));
await browser.close();
server.close();
