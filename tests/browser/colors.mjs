// Colours of the surface: the menu, the legend, the page's address, and colours in a file.
import http from "node:http";
import {
  assert, assertClean, browser, drop, fetchBytes, open, picture, run, stablePicture, start, waitForFrames,
  waitForMesh, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
const page = await start(chromium);
const surfaces = () => page.requests.filter((line) => line.includes("/surface.glb")).length;
const colored = (p) => p.evaluate(() => window.measures.filter((e) => e.atoms).length);
const ready = (p) => p.waitForFunction(() => !document.querySelector("#colour").disabled, null, { timeout: TIMEOUT_MS });
/** Chooses a scheme and waits for its frame. */
async function choose(scheme) {
  const before = await colored(page);
  await page.locator("#colour").selectOption(scheme);
  await page.waitForFunction((n) => window.measures.filter((e) => e.atoms).length > n, before, { timeout: TIMEOUT_MS });
}
const entries = (p) => p.locator("#legend .entry").allTextContents();
/** Returns the shares of clearly red and clearly blue pixels. */
function hues({ width, height, data }) {
  let [red, blue] = [0, 0];
  for (let i = 0; i < data.length; i += 4) {
    const [r, g, b] = data.subarray(i, i + 3);
    if (r > 80 && r > 1.6 * g && r > 1.6 * b) red += 1;
    if (b > 80 && b > 1.3 * g && b > 1.6 * r) blue += 1;
  }
  return { red: red / (width * height), blue: blue / (width * height) };
}

await run({
  "the menu recolours the surface without a new mesh": async () => {
    await ready(page);
    const plain = await stablePicture(page);
    assert.ok(hues(plain).red < 0.001 && hues(plain).blue < 0.001, JSON.stringify(hues(plain)));
    const before = surfaces();
    await choose("element");
    const { red, blue } = hues(await stablePicture(page));
    assert.ok(red > 0.01 && blue > 0.005, `${red} ${blue}`);
    assert.deepEqual((await entries(page)).sort(), ["C", "N", "O", "S"]);
    await choose("charge");
    assert.match(await page.locator("#legend").textContent(), /^-1\s*1$/);
    await choose("bfactor");
    const reply = await fetchBytes(`${new URL(page.requests.findLast((line) => line.includes("/colors?")).split(" ")[1]).pathname}?scheme=bfactor`);
    const { range } = JSON.parse(reply.headers.get("molmesh-colors"));
    assert.deepEqual([await page.locator("#legend .low").textContent(), await page.locator("#legend .high").textContent()], range.map(String));
    await page.locator("#colour").selectOption("none");
    await waitForFrames(page);
    const again = await stablePicture(page);
    const other = again.data.filter((value, i) => Math.abs(value - plain.data[i]) > 3).length;
    assert.ok(other < again.data.length / 1000, `${other} of ${again.data.length} values differ from the picture without colours`);
    assert.equal(await page.locator("#legend").isVisible(), false);
    assert.equal(surfaces(), before, "a mesh was requested");
    assertClean(page);
  },

  "the address and the command contain the colour scheme": async () => {
    await choose("element");
    assert.match(page.url(), /[?&]color=element/);
    assert.match(await page.locator("#curl").textContent(), /color=element/);
    const red = hues(await stablePicture(page)).red;
    await page.reload({ timeout: TIMEOUT_MS });
    await page.waitForFunction(() => window.measures.some((e) => e.atoms), null, { timeout: TIMEOUT_MS });
    assert.equal(await page.locator("#colour").inputValue(), "element");
    const again = hues(await stablePicture(page)).red;
    assert.ok(Math.abs(again - red) < 0.002, `${again} ${red}`);
    await ready(page);
  },

  "a scheme that does not suit the file gives an explanation": async () => {
    await page.locator("#colour").selectOption("entity");
    await page.locator("#problem strong").waitFor();
    assert.match(await page.locator("#problem").textContent(), /entities/);
    await choose("chain");
    page.errors = page.errors.filter((line) => !line.includes("400"));
  },

  "58,870 atoms are recoloured in less than half a second": async () => {
    const side = 39;
    const text = Array.from({ length: 58_870 }, (_, i) => {
      const at = [i % side, Math.floor(i / side) % side, Math.floor(i / side / side)].map((c) => (1.5 * c).toFixed(3).padStart(8)).join("");
      return `ATOM      1  CA  ALA ${"ABCDEFGHIJ"[i % 10]}${String(i % 9999).padStart(4)}    ${at}  1.00${(i % 90).toFixed(2).padStart(6)}           C`;
    }).join("\n");
    await waitForMesh(page, () => drop(page, "cube.pdb", Buffer.from(text)));
    await ready(page);
    // Other work would delay the first request.
    await waitForFrames(page);
    const before = surfaces();
    for (const scheme of ["bfactor", "element", "residue"]) await choose(scheme);
    const times = await page.evaluate(() => window.measures.filter((e) => e.atoms === 58_870).slice(-3).map((e) => [e.ms, e.received, e.drawn]));
    assert.equal(times.length, 3);
    console.log(`recoloured in ${times.map(([ms, received, drawn]) => `${ms.toFixed(1)} ms (response ${received.toFixed(1)}, frame ${drawn.toFixed(1)})`).join(", ")}`);
    assert.equal(surfaces(), before);
    assert.ok(Math.min(...times.map(([ms]) => ms)) < 500, JSON.stringify(times));
  },

  "the component shows the colours of a file and of a scheme": async () => {
    const element = (src, more) => `<!doctype html><html lang="en"><title>component</title><molmesh-viewer id="viewer" style="width: 300px; height: 300px" src="${SERVICE_URL}${src}" ${more}></molmesh-viewer><script type="module" src="${SERVICE_URL}/molmesh-viewer.js"></script>`;
    let html = "";
    const server = http.createServer((request, reply) => reply.writeHead(request.url === "/" ? 200 : 204, { "content-type": "text/html" }).end(html));
    await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
    const url = `http://127.0.0.1:${server.address().port}/`;
    const opened = async (src, more) => {
      html = element(src, more);
      const other = await open(chromium, { url, before: (p) => p.addInitScript(() => document.addEventListener("molmesh-load", () => (window.loaded = true))) });
      await other.waitForFunction(() => window.loaded, null, { timeout: TIMEOUT_MS });
      if (more.includes("scheme")) await other.waitForFunction(() => window.measures.some((e) => e.atoms), null, { timeout: TIMEOUT_MS });
      return [hues(await picture(other, "#viewer")), other];
    };
    const [plain] = await opened("/v1/pdb/1crn/surface.glb?resolution=1&atom_ids=true", "");
    assert.ok(plain.red < 0.001, JSON.stringify(plain));
    const [file] = await opened("/v1/pdb/1crn/surface.glb?resolution=1&color=element", "");
    assert.ok(file.red > 0.01, JSON.stringify(file));
    const [scheme, other] = await opened("/v1/pdb/1crn/surface.glb?resolution=1&atom_ids=true", 'scheme="element" menu');
    assert.ok(Math.abs(scheme.red - file.red) < 0.01, `${scheme.red} ${file.red}`);
    const menu = other.locator("#viewer select");
    assert.equal(await menu.inputValue(), "element");
    await menu.selectOption("charge");
    await other.locator("#viewer .legend .high").waitFor();
    assert.equal(await other.locator("#viewer").getAttribute("scheme"), "charge");
    server.close();
  },
});
