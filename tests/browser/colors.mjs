// Colours of the surface: the menu, the legend, the page's address, and colours in a file.
import http from "node:http";
import {
  assert, assertClean, browser, drop, fetchBytes, open, picture, run, stablePicture, start, waitForFrames,
  waitForMesh, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
// Small, because surfaces are compared by their pictures.
const page = await start(chromium, { viewport: { width: 600, height: 600 } });
const surfaces = () => page.requests.filter((line) => line.includes("/surface.glb")).length;
const colored = (p) => p.evaluate(() => window.measures.filter((e) => e.atoms).length);
const ready = (p) => p.waitForFunction(() => !document.querySelector("#colour").disabled, null, { timeout: TIMEOUT_MS });
/** Chooses a scheme and waits for its frame. */
async function choose(scheme) {
  const before = await colored(page);
  await page.locator("#colour").selectOption(scheme);
  await page.waitForFunction((n) => window.measures.filter((e) => e.atoms).length > n, before, { timeout: TIMEOUT_MS });
}
/** Returns hue (degrees), saturation and brightness (0 to 1). */
function hsv([r, g, b]) {
  const [high, low] = [Math.max(r, g, b), Math.min(r, g, b)];
  const span = high - low || 1;
  const sector = high === r ? (g - b) / span : high === g ? (b - r) / span + 2 : (r - g) / span + 4;
  return [(60 * sector + 360) % 360, high ? (high - low) / high : 0, high / 255];
}
const apart = (a, b) => Math.min(Math.abs(a - b), 360 - Math.abs(a - b));
/** Returns the share of pixels with a hue of the legend. */
function shareOf({ width, height, data }, legend) {
  const saturated = legend.map(hsv).filter(([, saturation]) => saturation > 0.25);
  let n = 0;
  for (let i = 0; i < data.length; i += 4) {
    const [hue, saturation, brightness] = hsv(data.subarray(i, i + 3));
    if (saturation > 0.2 && brightness > 0.15 && saturated.some(([other]) => apart(hue, other) < 12)) n += 1;
  }
  return n / (width * height);
}
/** Returns the colours of the page's legend, or of its single colour. */
const legendColors = () =>
  page.evaluate(() => {
    const single = document.querySelector("#single-colour");
    if (!single.hidden) return [[1, 3, 5].map((at) => Number.parseInt(single.value.slice(at, at + 2), 16))];
    const nodes = [...document.querySelectorAll("#legend .swatch, #legend .scale")];
    return nodes.flatMap((node) => [...node.style.background.matchAll(/rgb\((\d+), (\d+), (\d+)\)/g)].map((found) => found.slice(1).map(Number)));
  });
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

  "every scheme of the service colours the surface; only those of vertices need a mesh": async () => {
    const api = JSON.parse((await fetchBytes("/openapi.json")).bytes);
    const words = (name) => api.components.parameters[name].schema.title.split(", ");
    const menu = page.locator("#colour");
    const offered = await menu.locator("option").evaluateAll((nodes) => nodes.map((node) => node.value));
    const expected = words("color").filter((value) => value !== "map");
    assert.deepEqual(offered, expected.map((value) => (value.startsWith("uniform") ? "uniform:" : value)));
    await page.locator("#pdb").fill("1crn");
    await waitForMesh(page, () => page.locator("#pdb").press("Enter"));
    await ready(page);
    await waitForFrames(page);
    // Without a scheme the surface is grey, so that no hue of a legend is its own.
    await page.evaluate(() => document.documentElement.style.setProperty("--plain", "#8a8a8a"));
    for (let i = 0; i < 3; i += 1) await page.locator("#theme").click();
    const plain = await stablePicture(page);
    const before = surfaces();
    const ofVertices = [];
    for (const scheme of offered.slice(1)) {
      const isOfAtoms = scheme === "uniform:" || words("scheme").includes(scheme);
      if (isOfAtoms) await choose(scheme);
      else {
        ofVertices.push(scheme);
        await waitForMesh(page, () => menu.selectOption(scheme));
        assert.match(page.requests.findLast((line) => line.includes("/surface.glb")), new RegExp(`color=${scheme}&`));
      }
      if (scheme === "uniform:") {
        const shown = await colored(page);
        await page.locator("#single-colour").fill("#cc2222");
        await page.waitForFunction((n) => window.measures.filter((e) => e.atoms).length > n, shown, { timeout: TIMEOUT_MS });
        assert.match(page.url(), /color=uniform%3A%23cc2222/);
      }
      assert.equal(await menu.inputValue(), scheme);
      // The pockets of this structure may be hidden, or have few pixels.
      if (scheme === "pocket") continue;
      const legend = await legendColors();
      const [share, control] = [await picture(page), plain].map((taken) => shareOf(taken, legend));
      assert.ok(share > 0.01 && control < 0.001, `${scheme}: ${share}, without colours ${control}`);
    }
    assert.deepEqual(ofVertices, ["curvature", "radial", "depth", "pocket"]);
    assert.equal(surfaces(), before + ofVertices.length);
    // A mesh with colours takes those of atoms, and one colour, without another mesh.
    await choose("element");
    assert.deepEqual((await entries(page)).sort(), ["C", "N", "O", "S"]);
    await menu.selectOption("none");
    await waitForFrames(page);
    const again = await stablePicture(page);
    const other = again.data.filter((value, i) => Math.abs(value - plain.data[i]) > 3).length;
    assert.ok(other < again.data.length / 1000, `${other} values differ from the picture without colours`);
    assert.equal(surfaces(), before + ofVertices.length);
    assertClean(page);
  },

  "palettes are offered for numeric schemes; smooth colours need a mesh": async () => {
    const palette = page.locator("#palette");
    await choose("chain");
    assert.equal(await palette.isVisible(), false);
    await choose("bfactor");
    assert.equal(await palette.inputValue(), "viridis");
    const viridis = await legendColors();
    const before = [surfaces(), await colored(page)];
    await palette.selectOption("cividis");
    await page.waitForFunction((n) => window.measures.filter((e) => e.atoms).length > n, before[1], { timeout: TIMEOUT_MS });
    assert.notDeepEqual(await legendColors(), viridis);
    assert.equal(surfaces(), before[0]);
    assert.match(page.url(), /color=bfactor&palette=cividis/);
    const [low, high] = [page.locator("#legend .low"), page.locator("#legend .high")];
    await waitForMesh(page, () => page.locator("#colour").selectOption("curvature"));
    assert.deepEqual([await palette.inputValue(), await low.textContent(), await high.textContent()], ["blue-white-red", "-0.5", "0.5"]);
    assert.ok(!page.url().includes("palette"), page.url());
    await waitForMesh(page, () => palette.selectOption("viridis"));
    assert.equal(await palette.inputValue(), "viridis");
    await choose("element");
    await page.locator("#parameters details.more").evaluate((node) => (node.open = true));
    await waitForMesh(page, () => page.locator("#p-color_blend").selectOption("smooth"));
    assert.match(page.requests.findLast((line) => line.includes("/surface.glb")), /color=element&color_blend=smooth/);
    assert.deepEqual((await entries(page)).sort(), ["C", "N", "O", "S"]);
    await page.locator("#p-color_blend").selectOption("nearest");
    await page.locator("#colour").selectOption("none");
    await waitForMesh(page, () => page.locator("#sample").click());
    await ready(page);
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

  "58,870 atoms are recoloured without a new mesh": async () => {
    const side = 39;
    const text = Array.from({ length: 58_870 }, (_, i) => {
      const at = [i % side, Math.floor(i / side) % side, Math.floor(i / side / side)].map((c) => (1.5 * c).toFixed(3).padStart(8)).join("");
      return `ATOM      1  CA  ALA ${"ABCDEFGHIJ"[i % 10]}${String(i % 9999).padStart(4)}    ${at}  1.00${(i % 90).toFixed(2).padStart(6)}           C`;
    }).join("\n");
    await waitForMesh(page, () => drop(page, "cube.pdb", Buffer.from(text)));
    await ready(page);
    // The surface is shown in tiles.
    await page.waitForFunction(() => /tiles?, /.test(document.querySelector("#now").textContent) && !document.querySelector("#now").textContent.includes("loading"), null, { timeout: TIMEOUT_MS });
    // Other work would delay the first request.
    await waitForFrames(page);
    const before = surfaces();
    for (const scheme of ["bfactor", "element", "residue"]) await choose(scheme);
    const times = await page.evaluate(() => window.measures.filter((e) => e.atoms === 58_870).slice(-3).map((e) => [e.ms, e.received, e.applied, e.drawn]));
    assert.equal(times.length, 3);
    console.log(`recoloured in ${times.map((time) => time.map((ms) => ms.toFixed(1))).map(([ms, received, applied, drawn]) => `${ms} ms (response ${received}, colours ${applied}, frame ${drawn})`).join(", ")}`);
    assert.equal(surfaces(), before);
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
    const api = JSON.parse((await fetchBytes("/openapi.json")).bytes);
    const schemes = api.components.parameters.scheme.schema.title.split(", ").filter((value) => !value.startsWith("uniform"));
    assert.deepEqual(await menu.locator("option").evaluateAll((nodes) => nodes.map((node) => node.value).sort()), ["none", ...schemes].sort());
    await menu.selectOption("charge");
    await other.locator("#viewer .legend .high").waitFor();
    assert.equal(await other.locator("#viewer").getAttribute("scheme"), "charge");
    server.close();
  },
});
