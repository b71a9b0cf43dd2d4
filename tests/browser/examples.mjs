// The pages of examples/, as they stand but for the address of the service.
import http from "node:http";
import { readFileSync } from "node:fs";
import path from "node:path";
import { assert, browser, fetched, glb, MODULES, open, picture, ROOT, run, silhouette, URL_OF_SERVICE, PATIENCE } from "./lib.mjs";

/** Another origin: pages elsewhere embed what the service has. */
const server = http.createServer((request, reply) => {
  const name = new URL(request.url, "http://x").pathname;
  try {
    const isModule = name.startsWith("/node_modules/");
    const bytes = readFileSync(isModule ? path.join(MODULES, name.slice("/node_modules/".length)) : path.join(ROOT, "examples", name));
    const type = name.endsWith(".html") ? "text/html; charset=utf-8" : "text/javascript";
    reply.writeHead(200, { "content-type": type });
    reply.end(isModule ? bytes : bytes.toString().replaceAll("http://127.0.0.1:8080", URL_OF_SERVICE));
  } catch {
    reply.writeHead(name === "/favicon.ico" ? 204 : 404).end();
  }
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const origin = `http://127.0.0.1:${server.address().port}`;
const chromium = await browser();
const fine = (page) => assert.deepEqual(page.wrong.filter((line) => !line.startsWith("warning")), []);
const surface = await fetched("/v1/pdb/1crn/surface.glb");
const triangles = glb(surface.bytes).indices.count / 3;

await run({
  "the component shows a surface, and says what is picked": async () => {
    const page = await open(chromium, { url: `${origin}/component.html` });
    await page.locator("#said", { hasText: `${triangles} triangles` }).waitFor({ timeout: PATIENCE });
    const seen = silhouette(await picture(page, "#surface"));
    assert.ok(seen.share > 0.1 && seen.share < 0.7 && seen.brightness > 0.3, JSON.stringify(seen));
    const event = page.evaluate(() => new Promise((resolve) => document.querySelector("#surface").addEventListener("molmesh-pick", (e) => resolve(e.detail))));
    await page.locator("#surface").click();
    const { atom, point } = await event;
    const lines = readFileSync(path.join(ROOT, "samples/1crn.cif"), "utf8").split("\n").filter((line) => /^(ATOM|HETATM) /.test(line)).map((line) => line.trim().split(/\s+/));
    const columns = readFileSync(path.join(ROOT, "samples/1crn.cif"), "utf8").split("\n").filter((line) => line.startsWith("_atom_site.")).map((line) => line.trim().slice("_atom_site.".length));
    const at = (row, name) => lines[row][columns.indexOf(name)];
    await page.locator("#said", { hasText: "," }).waitFor({ timeout: PATIENCE });
    assert.equal(await page.locator("#said").textContent(), `${at(atom, "auth_comp_id")} ${at(atom, "auth_seq_id")} ${at(atom, "auth_asym_id")}, ${at(atom, "label_atom_id")}`);
    // No atom is much nearer to the place than the one that was named: a corner of the triangle says whose it is.
    const distance = (row) => Math.hypot(...["Cartn_x", "Cartn_y", "Cartn_z"].map((name, i) => Number(at(row, name)) - point[i]));
    const nearest = Math.min(...lines.map((_, row) => distance(row)));
    assert.ok(distance(atom) < nearest + 0.6, `${distance(atom)} ${nearest}`);
    const far = lines.findIndex((_, row) => distance(row) > nearest + 5);
    assert.ok(far >= 0, "the comparison can fail");
    // Attributes change what is shown, and failures are told.
    const loaded = page.evaluate(() => new Promise((resolve) => document.querySelector("#surface").addEventListener("molmesh-load", (e) => resolve(e.detail.report))));
    await page.evaluate(() => (document.querySelector("#surface").src += "&resolution=1"));
    assert.equal((await loaded).resolution, 1);
    fine(page);
    await page.evaluate(() => (document.querySelector("#surface").src = "/nothing.glb"));
    await page.locator("#said", { hasText: "404" }).waitFor({ timeout: PATIENCE });
    await page.context().close();
  },

  "model-viewer shows it": async () => {
    const page = await open(chromium, { url: `${origin}/model-viewer.html` });
    await page.waitForFunction(() => document.querySelector("#surface").loaded, null, { timeout: PATIENCE });
    await page.waitForFunction(() => document.querySelector("#surface").modelIsVisible, null, { timeout: PATIENCE });
    const seen = silhouette(await picture(page, "#surface"));
    assert.ok(seen.share > 0.05, JSON.stringify(seen));
    fine(page);
    await page.context().close();
  },

  "plain three.js shows it": async () => {
    const page = await open(chromium, { url: `${origin}/three.html` });
    await page.waitForFunction(() => document.title.includes("triangles"), null, { timeout: PATIENCE });
    assert.ok((await page.title()).startsWith(`${triangles} triangles`));
    const seen = silhouette(await picture(page, "canvas"));
    assert.ok(seen.share > 0.05 && seen.brightness > 0.3, JSON.stringify(seen));
    fine(page);
    await page.context().close();
  },
});
