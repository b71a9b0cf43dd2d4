// The pages of examples/, unchanged except for the address of the service.
import http from "node:http";
import { readFileSync } from "node:fs";
import path from "node:path";
import { assert, browser, fetchBytes, glb, open, picture, run, silhouette, MODULES, ROOT, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

/** Serves the examples from another origin than the service. */
const server = http.createServer((request, reply) => {
  const name = new URL(request.url, "http://x").pathname;
  try {
    const isModule = name.startsWith("/node_modules/");
    const bytes = readFileSync(isModule ? path.join(MODULES, name.slice("/node_modules/".length)) : path.join(ROOT, "examples", name));
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
