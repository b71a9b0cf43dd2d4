// three.js and model-viewer load every variant of GLB, with the sizes that the report states.
import http from "node:http";
import { readFileSync } from "node:fs";
import path from "node:path";
import { assert, browser, fetchBytes, glb, inverted, open, run, MODULES, ROOT, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

const PAGE = `<!doctype html><html lang="en"><meta charset="utf-8"><title>variants</title>
<script type="importmap">{ "imports": { "three": "/three/build/three.module.js" } }</script>
<script type="module" src="/@google/model-viewer/dist/model-viewer.min.js"></script>
<script>self.ModelViewerElement = { meshoptDecoderLocation: "/meshoptimizer/meshopt_decoder.cjs" };</script>
<model-viewer id="viewer" style="width: 64px; height: 64px"></model-viewer>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "/three/examples/jsm/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "/three/examples/jsm/libs/meshopt_decoder.module.js";
window.load = async (url) => {
  const { scene } = await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).loadAsync(url);
  const meshes = [];
  scene.traverse((object) => object.isMesh && meshes.push(object));
  scene.updateMatrixWorld(true);
  const size = new THREE.Box3().setFromObject(scene, true).getSize(new THREE.Vector3()).toArray();
  // Volume by the divergence theorem; its sign gives the winding of the triangles.
  const [a, b, c] = [0, 1, 2].map(() => new THREE.Vector3());
  let [volume, triangles] = [0, 0];
  const [kinds, colors, shades] = [new Set(), new Set(), new Set()];
  for (const { geometry, matrixWorld, material } of meshes) {
    triangles += geometry.index.count / 3;
    kinds.add(Object.keys(geometry.attributes).sort().join());
    for (let i = 0; i < geometry.index.count; i += 3) {
      [a, b, c].forEach((v, k) => v.fromBufferAttribute(geometry.getAttribute("position"), geometry.index.getX(i + k)).applyMatrix4(matrixWorld));
      volume += a.dot(b.cross(c)) / 6;
    }
    const color = geometry.getAttribute("color");
    if (!color) continue;
    colors.add([color.array.constructor.name, color.normalized, color.itemSize, material.vertexColors].join());
    for (let i = 0; i < color.count; i += 1) shades.add(new THREE.Color().fromBufferAttribute(color, i).getHexString());
  }
  const instances = meshes[0].isInstancedMesh ? meshes[0].count : null;
  return {
    size, volume, triangles, instances, kinds: [...kinds], colors: [...colors], shades: [...shades],
    parts: [...new Set(meshes.map((mesh) => mesh.userData.name ?? mesh.parent.userData.name ?? mesh.name))], indexBytes: meshes[0].geometry.index.array.BYTES_PER_ELEMENT,
  };
};
window.view = (url) => new Promise((resolve, reject) => {
  const viewer = document.querySelector("#viewer");
  viewer.addEventListener("load", () => { const { x, y, z } = viewer.getDimensions(); resolve([x, y, z]); }, { once: true });
  viewer.addEventListener("error", (event) => reject(new Error(JSON.stringify(event.detail))), { once: true });
  viewer.src = url;
});
window.ready = true;
</script></html>`;
const server = http.createServer((request, reply) => {
  const name = new URL(request.url, "http://x").pathname;
  if (name === "/") return reply.writeHead(200, { "content-type": "text/html; charset=utf-8" }).end(PAGE);
  try {
    const bytes = readFileSync(path.join(MODULES, name));
    reply.writeHead(200, { "content-type": "text/javascript" }).end(bytes);
  } catch {
    reply.writeHead(name === "/favicon.ico" ? 204 : 404).end();
  }
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const chromium = await browser();
const page = await open(chromium, { url: `http://127.0.0.1:${server.address().port}/` });
await page.waitForFunction(() => window.ready && customElements.get("model-viewer"), null, { timeout: TIMEOUT_MS });

const capabilities = JSON.parse((await fetchBytes("/v1/capabilities")).bytes);
const values = (name) => capabilities.parameters.find((p) => p.name === name).values;
const variants = [];
for (const compress of values("compress")) for (const normals of values("normals")) for (const atom_ids of ["false", "true"]) variants.push({ compress, normals, atom_ids, resolution: "0.9" });
for (const units of values("units")) for (const compress of values("compress")) variants.push({ units, compress, resolution: "0.9" });
// Fine meshes have indices of 32 bits.
for (const compress of values("compress")) variants.push({ compress, atom_ids: "true", resolution: "0.2" });
// Colours, of atoms and of vertices, and parts.
for (const compress of values("compress")) for (const atom_ids of ["false", "true"]) for (const normals of values("normals")) variants.push({ compress, atom_ids, normals, color: "element", resolution: "0.9" });
for (const compress of values("compress")) for (const color of ["curvature", "chain"]) for (const split of values("split")) variants.push({ compress, color, split, select: "all", resolution: "0.9", atom_ids: "true" });
for (const compress of values("compress")) variants.push({ compress, color: "element", color_blend: "smooth", split: "chain", normals: "none", assembly: "1", units: "nanometer", resolution: "0.9" });
// Two chains, ligands and water.
const complex = await fetchBytes("/v1/structures", { method: "POST", body: readFileSync(path.join(ROOT, "tests/structures/1pfe.cif.gz")) });
const { digest } = JSON.parse(complex.bytes);
const close = (a, b, tolerance) => Math.abs(a - b) <= tolerance * Math.abs(b);

await run({
  [`three.js and model-viewer load ${variants.length} variants`]: async () => {
    const indexBytes = new Set();
    for (const variant of variants) {
      const base = variant.color ? `/v1/structures/${digest}` : "/v1/pdb/1crn";
      const address = `${base}/surface.glb?${new URLSearchParams(variant)}`;
      const { bytes, headers, status } = await fetchBytes(address);
      assert.equal(status, 200, address);
      const { json } = glb(bytes);
      const scale = json.asset.extras.unit_scale;
      const three = await page.evaluate((url) => window.load(url), SERVICE_URL + address);
      assert.equal(three.triangles, Number(headers.get("molmesh-triangles")), address);
      assert.ok(close(three.volume * scale ** 3, Number(headers.get("molmesh-volume")), 2e-3), `${address}: ${three.volume}`);
      const attributes = ["position", ...(variant.normals === "none" ? [] : ["normal"]), ...(variant.atom_ids === "true" ? ["_atom"] : []), ...(variant.color ? ["color"] : [])];
      assert.deepEqual(three.kinds, [attributes.sort().join()], address);
      const stored = variant.compress === "none" ? "Float32Array,false,4,true" : "Uint16Array,true,4,true";
      assert.deepEqual(three.colors, variant.color ? [stored] : [], address);
      const { parts, color } = json.asset.extras;
      const isDivided = variant.split !== undefined && variant.split !== "none";
      assert.equal(three.parts.length > 1, isDivided, address);
      if (isDivided) assert.deepEqual(three.parts, parts.filter(({ triangles }) => triangles > 0).map(({ name }) => name), address);
      // The colours are those of the legend, in sRGB.
      if (color && !color.range && !color.blend) {
        const legend = color.legend.map((entry) => entry.color.slice(1));
        assert.ok(three.shades.length > 1 && three.shades.every((shade) => legend.includes(shade)), `${address}: ${three.shades} ${legend}`);
      }
      indexBytes.add(three.indexBytes);
      const viewed = await page.evaluate((url) => window.view(url), SERVICE_URL + address);
      viewed.forEach((side, i) => assert.ok(close(side, three.size[i], 1e-2), `${address}: ${viewed} ${three.size}`));
    }
    assert.deepEqual([...indexBytes].sort(), [2, 4], "sizes of indices");
  },

  "an inverted mesh has a negative volume": async () => {
    const address = "/v1/pdb/1crn/surface.glb?resolution=0.9";
    await page.route("**/inverted.glb", async (route) => route.fulfill({ contentType: "model/gltf-binary", body: inverted((await fetchBytes(address)).bytes) }));
    const three = await page.evaluate((url) => window.load(url), "/inverted.glb");
    assert.ok(three.volume < 0, `${three.volume}`);
  },

  "three.js repeats the mesh of an assembly": async () => {
    const [plain, repeated] = await Promise.all(
      ["", "&assembly=1&instances=true"].map((more) => page.evaluate((url) => window.load(url), `${SERVICE_URL}/v1/pdb/1crn/surface.glb?resolution=0.9${more}`)),
    );
    assert.deepEqual([plain.instances, repeated.instances], [null, 1]);
    repeated.size.forEach((side, i) => assert.ok(close(side, plain.size[i], 1e-5), `${repeated.size} ${plain.size}`));
  },

  "the page has no errors": async () => {
    assert.deepEqual(page.errors.filter((line) => !line.startsWith("warning")), []);
  },
});
