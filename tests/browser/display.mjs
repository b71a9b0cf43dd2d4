// Display of the page: sticks of ligands, transparency, chains, assemblies, views, and links that restore all of them.
import { readFileSync } from "node:fs";
import http from "node:http";
import path from "node:path";
import {
  assert, assertClean, axe, browser, drop, fetchBytes, open, picture, run, stablePicture, start, waitForMesh, ROOT, SERVICE_URL,
  TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
// Small, because surfaces are compared by their pictures.
const viewport = { width: 640, height: 600 };
const page = await start(chromium, { viewport });
// DNA (chain A) with an antibiotic (chain B, with two quinoxaline-2-carboxylic acids) and an assembly of two copies.
const complex = readFileSync(path.join(ROOT, "tests/structures/1pfe.cif.gz"));
const surfaces = () => page.requests.filter((line) => line.includes("/surface.glb"));
const sticks = (p) =>
  p.evaluate(() => window.measures.filter((e) => e.sticks).map(({ sticks, bonds }) => ({ sticks, bonds })));
const note = page.locator("#sticks-note");
/** Counts the values that differ by more than dithering does. */
const differing = (a, b) => a.data.filter((value, i) => Math.abs(value - b.data[i]) > 8).length;
/** Sets the transparency with the events of a user's input. */
const veil = (percent) =>
  page.locator("#transparency").evaluate((slider, percent) => {
    slider.value = String(percent);
    for (const type of ["input", "change"]) slider.dispatchEvent(new Event(type, { bubbles: true }));
  }, percent);
/** Runs `act` and waits for other sticks. */
async function waitForSticks(p, act) {
  const before = (await sticks(p)).length;
  await act();
  await p.waitForFunction((n) => window.measures.filter((e) => e.sticks).length > n, before, { timeout: TIMEOUT_MS });
  return (await sticks(p)).at(-1);
}
const controls = (p) =>
  p.evaluate(() => ({
    sticks: document.querySelector("#sticks").checked,
    transparency: document.querySelector("#transparency").value,
    byChain: document.querySelector("#by-chain").checked,
    assembly: document.querySelector("#p-assembly").value,
    scheme: document.querySelector("#colour").value,
    palette: document.querySelector("#palette").value,
    legend: document.querySelector("#legend").textContent,
    parts: [...document.querySelectorAll("#parts input")].map((box) => [box.parentElement.textContent, box.checked]),
    note: document.querySelector("#sticks-note").textContent,
    address: location.search,
  }));

await run({
  "a structure without ligands has no sticks": async () => {
    await page.locator("#sticks").check();
    await page.waitForFunction(() => /No ligands/.test(document.querySelector("#sticks-note").textContent));
    assert.match(page.url(), /[?&]sticks=true/);
    await page.locator("#sticks").uncheck();
    assert.equal(await note.textContent(), "");
    assert.ok(!page.url().includes("sticks"), page.url());
    assert.deepEqual(await sticks(page), []);
    page.errors = page.errors.filter((line) => !line.includes("422"));
  },

  "ligands are sticks with the bonds of their chemistry under a transparent surface": async () => {
    await waitForMesh(page, () => drop(page, "1pfe.cif.gz", complex));
    const before = surfaces().length;
    const opaque = await stablePicture(page);
    await veil(70);
    const clear = await stablePicture(page);
    assert.ok(differing(opaque, clear) > 5000, "the surface is still opaque");
    // Each residue has 12 atoms other than hydrogen and 13 bonds between them.
    assert.deepEqual(await waitForSticks(page, () => page.locator("#sticks").check()), { sticks: 24, bonds: 26 });
    assert.equal(await note.textContent(), "24 atoms: QUI");
    const withSticks = await stablePicture(page);
    assert.ok(differing(clear, withSticks) > 500, "no sticks are visible");
    // Below an opaque surface, fewer pixels show sticks.
    await veil(0);
    const covered = differing(opaque, await stablePicture(page));
    assert.ok(covered < differing(clear, withSticks), `${covered}`);
    await page.locator("#sticks").uncheck();
    assert.equal(differing(opaque, await stablePicture(page)), 0);
    assert.equal(surfaces().length, before, "a mesh was requested");
  },

  "the assembly is chosen from a menu, and its ligands are those of all copies": async () => {
    const menu = page.locator("#p-assembly");
    assert.deepEqual(await menu.locator("option").allTextContents(), ["asymmetric-unit", "1 (copies: 2)"]);
    await page.locator("#sticks").check();
    await page.getByText("24 atoms: QUI").waitFor();
    const two = await waitForSticks(page, () => waitForMesh(page, () => menu.selectOption("1")));
    assert.deepEqual(two, { sticks: 48, bonds: 52 });
    assert.match(surfaces().at(-1), /assembly=1/);
  },

  "chains are switched on and off without a request": async () => {
    await page.locator("#home").click();
    await waitForMesh(page, () => page.locator("#by-chain").check());
    assert.match(surfaces().at(-1), /split=chain/);
    const parts = page.locator("#parts label");
    assert.deepEqual(await parts.allTextContents(), ["A-1", "B-1", "A-2", "B-2"]);
    // The report of the mesh may follow later. Chromium requests the icon after a change of the address.
    const requests = () => page.requests.filter((line) => !/\/report\.json$|\/icon\.svg$/.test(line));
    const [all, before] = [await stablePicture(page), requests().length];
    for (const name of ["A-1", "B-2"]) await page.getByLabel(name, { exact: true }).uncheck();
    const some = await stablePicture(page);
    assert.ok(differing(all, some) > 5000, "no chain disappeared");
    assert.deepEqual(requests().slice(before), []);
    assert.match(page.url(), /hide=A-1,B-2/);
    assert.deepEqual(await axe(page), []);
  },

  "a link shows the same": async () => {
    await veil(60);
    await page.locator("#colour").selectOption("bfactor");
    await page.locator("#palette").waitFor();
    await page.locator("#palette").selectOption("cividis");
    await page.waitForFunction(() => location.search.includes("palette=cividis"));
    await page.locator("#home").click();
    await page.waitForFunction(() => !location.search.includes("camera"));
    // The view belongs to the link, in any order of turning, magnifying and shifting.
    await page.locator("#view-home").focus();
    for (const key of ["ArrowRight", "ArrowRight", "ArrowUp", "+"]) await page.keyboard.press(key);
    await page.waitForFunction(() => /camera=-5\.96\d*,0\.98\d*,1\.15$/.test(location.search));
    const { x, y, width, height } = await page.locator("#view-home").boundingBox();
    await page.mouse.move(x + width / 2, y + height / 2);
    await page.mouse.down({ button: "right" });
    await page.mouse.move(x + width / 2 + 60, y + height / 2 + 30, { steps: 5 });
    await page.mouse.up({ button: "right" });
    await page.waitForFunction(() => /camera=-5\.96\d*,0\.98\d*,1\.15,-/.test(location.search));
    await page.mouse.move(1, 1);
    await page.evaluate(() => document.activeElement.blur());
    const [expected, wanted] = [await stablePicture(page), await controls(page)];
    const { sticks: drawn, transparency, byChain, assembly, scheme, palette } = wanted;
    const chosen = [drawn, transparency, byChain, assembly, scheme, palette];
    assert.deepEqual(chosen, [true, "60", true, "1", "bfactor", "cividis"]);
    const linked = async (url) => {
      const other = await open(chromium, { url, viewport });
      const ready = () => {
        const has = (name) => window.measures.some((e) => e[name]);
        return has("atoms") && (has("sticks") || !document.querySelector("#sticks").checked);
      };
      await other.waitForFunction(ready, null, { timeout: TIMEOUT_MS });
      await other.mouse.move(1, 1);
      const found = [await stablePicture(other), await controls(other)];
      assertClean(other);
      await other.context().close();
      return found;
    };
    const [same, state] = await linked(page.url());
    assert.deepEqual(state, wanted);
    // The view of the link is rounded.
    assert.ok(differing(expected, same) < 100, `${differing(expected, same)} values of the picture differ`);
    // Every part of the display changes the picture.
    for (const name of ["sticks", "transparency", "hide", "color", "camera"]) {
      const url = new URL(page.url());
      if (name === "color") url.searchParams.set(name, "element");
      else url.searchParams.delete(name);
      if (name === "color") url.searchParams.delete("palette");
      const [other] = await linked(url.href);
      assert.ok(differing(expected, other) > 500, `without ${name} the picture is the same`);
    }
    // Values that cannot be used are ignored.
    const [, odd] = await linked(`${SERVICE_URL}/?pdb=1crn&color=element&transparency=nine&sticks=maybe&hide=%25zz&camera=1,2`);
    assert.deepEqual([odd.sticks, odd.transparency, odd.parts], [false, "0", []]);
    assert.ok(!/camera/.test(odd.address), odd.address);
  },

  "another structure shows all its parts": async () => {
    await waitForMesh(page, () => page.locator("#pdb").fill("1crn").then(() => page.locator("#pdb").press("Enter")));
    const { address, transparency } = await controls(page);
    assert.ok(!/hide|assembly|camera/.test(address), address);
    assert.equal(transparency, "60");
    // Back to the structure with its hidden chains.
    await waitForMesh(page, () => page.goBack());
    assert.match(page.url(), /hide=A-1,B-2/);
    assert.deepEqual((await controls(page)).parts, [["A-1", false], ["B-1", true], ["A-2", true], ["B-2", false]]);
    assert.ok((await picture(page)).data.length > 0);
  },

  "the component draws ligands and a transparent surface": async () => {
    const { bytes } = await fetchBytes("/v1/structures", { method: "POST", body: complex });
    const src = `${SERVICE_URL}${JSON.parse(bytes).surface}?resolution=1&assembly=1`;
    const [ready, style] = ["document.addEventListener('molmesh-load', () => (window.loaded = true))", "width: 400px; height: 400px"];
    const html = `<!doctype html><html lang="en"><title>component</title><script>${ready}</script><molmesh-viewer id="viewer"
      style="${style}" src="${src}"></molmesh-viewer><script type="module" src="${SERVICE_URL}/molmesh-viewer.js"></script>`;
    const headers = { "content-type": "text/html" };
    const server = http.createServer((request, reply) => reply.writeHead(request.url === "/" ? 200 : 204, headers).end(html));
    await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
    const other = await open(chromium, { url: `http://127.0.0.1:${server.address().port}/` });
    await other.waitForFunction(() => window.loaded, null, { timeout: TIMEOUT_MS });
    const set = (name, value) => other.locator("#viewer").evaluate((node, [name, value]) => node.setAttribute(name, value), [name, value]);
    const opaque = await stablePicture(other, "#viewer");
    await set("transparency", "70");
    const clear = await stablePicture(other, "#viewer");
    assert.ok(differing(opaque, clear) > 5000, "the surface is still opaque");
    assert.deepEqual(await waitForSticks(other, () => set("sticks", "")), { sticks: 48, bonds: 52 });
    const withSticks = await stablePicture(other, "#viewer");
    assert.ok(differing(clear, withSticks) > 500, "no sticks are visible");
    // Attributes that are removed or invalid have their defaults.
    await other.locator("#viewer").evaluate((node) => node.removeAttribute("sticks"));
    assert.equal(differing(clear, await stablePicture(other, "#viewer")), 0);
    await set("transparency", "nine");
    assert.equal(differing(opaque, await stablePicture(other, "#viewer")), 0);
    assert.deepEqual(other.errors, []);
    server.close();
  },

  "the page has no errors": async () => {
    assertClean(page, /422 \(Unprocessable/, /400 \(Bad Request\)/);
  },
});
