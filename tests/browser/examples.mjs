// The pages of examples/ and the code of docs/start/web.md and docs/api/clients.md, unchanged except for the address of
// the service.
import http from "node:http";
import { readFileSync } from "node:fs";
import path from "node:path";
import { assert, browser, fetchBytes, glb, open, picture, run, silhouette, MODULES, ROOT, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

/** Returns the blocks of a page of docs/ in a language. */
const blocks = (page, language) => [...readFileSync(path.join(ROOT, "docs", page), "utf8").matchAll(new RegExp("^```" + language + "\\n(.*?)^```", "gms"))].map(([, code]) => code);
// The scripts use a loader and a file of the user. Those of clients.md continue each other.
const codes = [...blocks("start/web.md", "js"), ...blocks("start/web.md", "ts"), blocks("api/clients.md", "js").join("")];
const scripts = codes.map((code) => `<script type="module">${code}\nfinished += 1;</script>`);
const pages = {
  "/first.html": blocks("start/web.md", "html")[0],
  "/scripts.html": `<!doctype html><title>scripts</title><script type="importmap">{ "imports": {
      "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/", "@molmesh/client": "/client/index.js", "@molmesh/client/viewer": "/client/viewer/molmesh-viewer.js"
    } }</script>
    <script>var finished = 0, file = new Blob([${JSON.stringify(readFileSync(path.join(ROOT, "samples/1crn.cif"), "utf8"))}]);</script>
    <script type="module">import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js"; window.GLTFLoader = GLTFLoader;</script>${scripts.join("")}`,
};

/** Serves the examples from another origin than the service. */
const server = http.createServer((request, reply) => {
  const name = new URL(request.url, "http://x").pathname;
  try {
    const isModule = name.startsWith("/node_modules/");
    const folder = name.startsWith("/client/") ? "web/client/dist" : "examples";
    const file = isModule ? path.join(MODULES, name.slice("/node_modules/".length)) : path.join(ROOT, folder, name.replace("/client/", "/"));
    const bytes = pages[name] ?? readFileSync(file);
    const type = name.endsWith(".html") ? "text/html; charset=utf-8" : "text/javascript";
    reply.writeHead(200, { "content-type": type });
    reply.end(isModule ? bytes : bytes.toString().replaceAll("http://127.0.0.1:8080", SERVICE_URL));
  } catch {
    reply.writeHead(name === "/favicon.ico" ? 204 : 404).end();
  }
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const origin = `http://127.0.0.1:${server.address().port}`;
const chromium = await browser();
const assertNoErrors = (page) => assert.deepEqual(page.errors.filter((line) => !line.startsWith("warning")), []);
const surface = await fetchBytes("/v1/pdb/1crn/surface.glb");
const triangles = glb(surface.bytes).indices.count / 3;

await run({
  "the component shows a surface and names the atom that is clicked": async () => {
    const page = await open(chromium, { url: `${origin}/component.html` });
    await page.locator("#message", { hasText: `${triangles} triangles` }).waitFor({ timeout: TIMEOUT_MS });
    const shape = silhouette(await picture(page, "#surface"));
    assert.ok(shape.share > 0.1 && shape.share < 0.7 && shape.brightness > 0.3, JSON.stringify(shape));
    const event = page.evaluate(() => new Promise((resolve) => document.querySelector("#surface").addEventListener("molmesh-pick", (e) => resolve(e.detail))));
    await page.locator("#surface").click();
    const { atom, point } = await event;
    const lines = readFileSync(path.join(ROOT, "samples/1crn.cif"), "utf8").split("\n").filter((line) => /^(ATOM|HETATM) /.test(line)).map((line) => line.trim().split(/\s+/));
    const columns = readFileSync(path.join(ROOT, "samples/1crn.cif"), "utf8").split("\n").filter((line) => line.startsWith("_atom_site.")).map((line) => line.trim().slice("_atom_site.".length));
    const at = (row, name) => lines[row][columns.indexOf(name)];
    await page.locator("#message", { hasText: "," }).waitFor({ timeout: TIMEOUT_MS });
    assert.equal(await page.locator("#message").textContent(), `${at(atom, "auth_comp_id")} ${at(atom, "auth_seq_id")} ${at(atom, "auth_asym_id")}, ${at(atom, "label_atom_id")}`);
    // The named atom is nearly the nearest one; the atom index comes from a corner of the triangle.
    const distance = (row) => Math.hypot(...["Cartn_x", "Cartn_y", "Cartn_z"].map((name, i) => Number(at(row, name)) - point[i]));
    const nearest = Math.min(...lines.map((_, row) => distance(row)));
    assert.ok(distance(atom) < nearest + 0.6, `${distance(atom)} ${nearest}`);
    const far = lines.findIndex((_, row) => distance(row) > nearest + 5);
    assert.ok(far >= 0, "no atom is far away: the comparison cannot fail");
    // A new `src` loads another surface, and a failure gives a message.
    const loaded = page.evaluate(() => new Promise((resolve) => document.querySelector("#surface").addEventListener("molmesh-load", (e) => resolve(e.detail.report))));
    await page.evaluate(() => (document.querySelector("#surface").src += "&resolution=1"));
    assert.equal((await loaded).resolution, 1);
    assertNoErrors(page);
    await page.evaluate(() => (document.querySelector("#surface").src = "/nothing.glb"));
    await page.locator("#message", { hasText: "404" }).waitFor({ timeout: TIMEOUT_MS });
    await page.context().close();
  },

  "the code of the documentation runs": async () => {
    assert.ok(scripts.length >= 6, `${scripts.length} blocks`);
    const first = await open(chromium, { url: `${origin}/first.html` });
    await first.waitForFunction(() => document.querySelector("molmesh-viewer").shadowRoot?.querySelector(".legend")?.textContent, null, { timeout: TIMEOUT_MS });
    const shape = silhouette(await picture(first, "molmesh-viewer"));
    assert.ok(shape.share > 0.05, JSON.stringify(shape));
    assertNoErrors(first);
    await first.context().close();
    const lines = [];
    const page = await open(chromium, { before: (page) => page.on("console", (message) => lines.push(message.text())), url: `${origin}/scripts.html` });
    await page.waitForFunction((n) => window.finished === n, scripts.length, { timeout: TIMEOUT_MS });
    assert.ok(lines.some((line) => line.startsWith(`${triangles} triangles`)) && lines.some((line) => /^\d+ is the atom of vertex 0$/.test(line)), lines.join("; "));
    // The last script of clients.md shows a rejected request.
    assert.deepEqual(page.errors.filter((line) => !line.startsWith("warning") && !line.includes("status of 422")), []);
    await page.context().close();
  },

  "model-viewer shows a surface": async () => {
    const page = await open(chromium, { url: `${origin}/model-viewer.html`, viewport: { width: 480, height: 400 } });
    await page.waitForFunction(() => document.querySelector("#surface").loaded, null, { timeout: TIMEOUT_MS });
    await page.waitForFunction(() => document.querySelector("#surface").modelIsVisible, null, { timeout: TIMEOUT_MS });
    const shape = silhouette(await picture(page, "#surface"));
    assert.ok(shape.share > 0.05, JSON.stringify(shape));
    assertNoErrors(page);
    await page.context().close();
  },

  "three.js shows a surface": async () => {
    const page = await open(chromium, { url: `${origin}/three.html` });
    await page.waitForFunction(() => document.title.includes("triangles"), null, { timeout: TIMEOUT_MS });
    assert.ok((await page.title()).startsWith(`${triangles} triangles`));
    const shape = silhouette(await picture(page, "canvas"));
    assert.ok(shape.share > 0.05 && shape.brightness > 0.3, JSON.stringify(shape));
    assertNoErrors(page);
    await page.context().close();
  },
});
