// The page at `/`.
import { readFileSync } from "node:fs";
import {
  assert, assertClean, axe, browser, deferred, degenerate, drop, fetchBytes, fetchUncompressed, glb, inverted, meshesShown, open, picture,
  pictureFault, plainColor, reportValue, run, sample, silhouette, slide, stablePicture, start, uncompressed, waitForFrames,
  waitForMesh, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
const page = await start(chromium);
const surfaces = (p) => p.requests.filter((line) => line.includes("/surface.glb"));
const path = (line) => line.slice(line.indexOf("/v1/"));
const meshOf = async (p) => (await fetchBytes(uncompressed(path(surfaces(p).at(-1))))).bytes;
const atomsOf = (file) => readFileSync(sample(file), "utf8").split("\n").filter((l) => /^(ATOM|HETATM)/.test(l));
const pinned = (p) => p.locator("#picked").textContent();

await run({
  "the sample is shown with its report": async () => {
    assert.equal(await page.locator("#structure-name").textContent(), "4PTI");
    const { headers } = await fetchBytes(path(surfaces(page)[0]));
    assert.equal(await reportValue(page, "triangles"), Number(headers.get("molmesh-triangles")));
    assert.ok(Math.abs((await reportValue(page, "area")) - Number(headers.get("molmesh-area"))) < 0.1);
    assert.match(await page.locator("#report .checks").textContent(), /✓ closed/);
    // Times and devices come with the report of the service.
    await page.locator("#report .why", { hasText: /cpu.*thread.* \(/ }).waitFor();
    assert.ok((await page.locator("#report .times tr").count()) >= 5, "stages with their times");
  },

  "the surface is seen from outside; blank and inverted surfaces fail the check": async () => {
    const plain = await plainColor(page);
    assert.equal(pictureFault(await picture(page), await meshOf(page), plain), null);
    for (const [change, expected] of [[inverted, /dark/], [degenerate, /silhouette/]]) {
      const other = await start(chromium, {
        before: (p) => p.route("**/surface.glb*", async (route) => {
          const reply = await fetchUncompressed(route);
          await route.fulfill({ response: reply, body: change(await reply.body()) });
        }),
      });
      assert.match(pictureFault(await picture(other), await meshOf(page), plain) ?? "nothing", expected);
      await other.context().close();
    }
  },

  "every parameter of the API document has a control": async () => {
    const api = JSON.parse((await fetchBytes("/openapi.json")).bytes);
    const parameter = (p) => (p.$ref ? api.components.parameters[p.$ref.split("/").pop()] : p);
    const names = (described) => described.paths["/v1/meshes"].post.parameters.map(parameter).filter((p) => p.in === "query" && !["format", "color_offset", "tile"].includes(p.name)).map((p) => p.name);
    const controls = (p) => p.locator("[data-parameter]").evaluateAll((nodes) => nodes.map((n) => n.dataset.parameter).sort());
    assert.ok(names(api).length > 20);
    assert.deepEqual(await controls(page), names(api).sort());
    const parameters = api.paths["/v1/meshes"].post.parameters;
    parameters.push({ name: "wobble", in: "query", description: "Amplitude.", schema: { type: "number", minimum: 0, maximum: 1, default: 0.5 } });
    api.components.schemas.Surface.enum.push("cubic");
    const other = await start(chromium, { before: (p) => p.route("**/openapi.json", (route) => route.fulfill({ json: api })) });
    assert.deepEqual(await controls(other), names(api).sort());
    assert.ok((await other.locator("#p-surface option").allTextContents()).includes("cubic"));
    // The service rejects the unknown parameter, and the page offers to reset it.
    await other.locator("#parameters details.more summary").click();
    await slide(other, "wobble", 800);
    await other.locator("#problem strong").waitFor();
    assert.ok(surfaces(other).at(-1).includes("wobble=0.8"), surfaces(other).at(-1));
    assert.match(await other.locator("#problem").textContent(), /unknown parameter `wobble`/);
    // The surface shown has no `wobble`, so nothing is requested and no error follows.
    const before = surfaces(other).length;
    await other.getByRole("button", { name: "Reset wobble", exact: true }).click();
    await other.locator("#busy").waitFor({ state: "hidden" });
    assert.deepEqual([await other.locator("#problem").isHidden(), surfaces(other).length], [true, before]);
    assertClean(other, /400 \(Bad Request\)/);
    await other.context().close();
  },

  "a slider requests a mesh; the latest request replaces earlier ones, which are cancelled": async () => {
    const released = deferred();
    const aborted = [];
    page.on("requestfailed", (request) => aborted.push(`${request.url()} ${request.failure().errorText}`));
    await page.route(/surface\.glb.*isovalue=2/, async (route) => {
      await released.promise;
      await route.continue().catch(() => undefined);
    });
    const before = await meshesShown(page);
    await page.locator("#p-isovalue").fill("2");
    await Promise.all([page.waitForRequest(/isovalue=2&/), page.locator("#p-isovalue").press("Enter")]);
    await waitForMesh(page, () => slide(page, "isovalue", 400));
    const last = Number(/isovalue=([\d.]+)/.exec(surfaces(page).at(-1))[1]);
    assert.ok(aborted.some((line) => /isovalue=2(&| ).*ERR_ABORTED/.test(line)), `${aborted}`);
    released.resolve();
    await waitForFrames(page);
    assert.equal(await meshesShown(page), before + 1);
    assert.equal(await reportValue(page, "isovalue"), last);
    assert.ok(last > 0.2 && last < 1, `${last}`);
    await page.unroute(/surface\.glb.*isovalue=2/);
  },

  "parameters survive a reload and can be reset": async () => {
    await waitForMesh(page, () => page.locator("#p-preset").selectOption("ses-like"));
    const requested = path(surfaces(page).at(-1));
    assert.match(requested, /preset=ses-like/);
    assert.match(await page.locator("#curl").textContent(), /preset=ses-like/);
    await page.reload({ timeout: TIMEOUT_MS });
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    assert.equal(path(surfaces(page).at(-1)), requested);
    assert.equal(await page.locator("#p-preset").inputValue(), "ses-like");
    await waitForMesh(page, () => page.locator("#reset-all").click());
    assert.ok(!surfaces(page).at(-1).includes("preset"));
  },

  "a dropped file is uploaded once and meshed": async () => {
    const posts = () => page.requests.filter((line) => line.startsWith("POST")).length;
    const before = posts();
    await waitForMesh(page, () => drop(page, "1crn.cif", readFileSync(sample("1crn.cif"))));
    assert.equal(await page.locator("#structure-name").textContent(), "1CRN");
    await waitForMesh(page, () => slide(page, "smoothness", 300));
    assert.equal(posts(), before + 1);
    assert.match(await page.locator("#curl").textContent(), /^curl -sS --fail-with-body --data-binary @1crn.cif/);
    await waitForMesh(page, () => page.setInputFiles("#file", sample("4pti.pdb")));
    assert.equal(await page.locator("#structure-name").textContent(), "4PTI");
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "clicking names the atom of the file at that point": async () => {
    const lines = atomsOf("4pti.pdb");
    const place = page.locator("#view-home");
    const { width, height } = await place.boundingBox();
    await page.waitForFunction(() => !document.querySelector("#colour").disabled);
    for (const [x, y] of [[0.5, 0.5], [0.45, 0.6], [0.55, 0.42]]) {
      await place.click({ position: { x: x * width, y: y * height } });
      const text = await pinned(page);
      const row = Number(/atom (\d+) of the file/.exec(text)[1]) - 1;
      const [name, residue, chain, number] = [[12, 16], [17, 20], [21, 22], [22, 26]].map(([a, b]) => lines[row].slice(a, b).trim());
      assert.ok(text.startsWith(`${residue} ${number} · ${name}chain ${chain},`), `${text} is not ${lines[row]}`);
    }
    // The search turns the residue to the front, so the atom in the middle belongs to it.
    await page.locator("#find").fill("A LYS 15");
    await page.locator("#find").press("Enter");
    assert.match(await pinned(page), /^LYS 15 · CA/);
    await place.focus();
    await page.keyboard.press("Enter");
    assert.match(await pinned(page), /^LYS 15 ·/);
    // Hovering shows the label and highlights the residue.
    await page.keyboard.press("Escape");
    const unmarked = await picture(page);
    await place.hover({ position: { x: 0.5 * width, y: 0.5 * height } });
    await page.locator("#tip").waitFor();
    assert.match(await page.locator("#tip").textContent(), /^LYS 15 A ·/);
    const marked = await picture(page);
    const changed = marked.data.filter((v, i) => Math.abs(v - unmarked.data[i]) > 40).length;
    assert.ok(changed > 200, `${changed} values changed`);
    await page.locator("#find").fill("TRP 999");
    await page.locator("#find").press("Enter");
    assert.match(await pinned(page), /no residue/);
    await page.locator("#home").click();
  },

  "each download equals the file at its address": async () => {
    await waitForMesh(page, () => page.locator("#p-resolution").fill("0.8").then(() => page.locator("#p-resolution").press("Enter")));
    const structure = /\/v1\/structures\/[0-9a-f]+/.exec(surfaces(page).at(-1))[0];
    const formats = await page.locator("#formats button").evaluateAll((nodes) => nodes.map((n) => n.dataset.format));
    const capabilities = JSON.parse((await fetchBytes("/v1/capabilities")).bytes);
    assert.deepEqual(formats, capabilities.formats.map((f) => f.name));
    for (const format of formats) {
      const button = page.locator(`#formats button[data-format="${format}"]`);
      await button.hover();
      if (format !== "png") await page.locator("#size", { hasText: new RegExp(`^${format}: about`, "i") }).waitFor();
      const size = await page.locator("#size").textContent();
      const [download] = await Promise.all([page.waitForEvent("download"), button.click()]);
      assert.equal(download.suggestedFilename(), format === "ply-text" ? "4PTI.ply" : `4PTI.${format}`);
      const direct = await fetchBytes(`${structure}/surface.${format}?resolution=0.8`);
      assert.equal(direct.status, 200);
      assert.ok(readFileSync(await download.path()).equals(direct.bytes), format);
      const kilobytes = Number(/([\d.]+) kB$/.exec(size)?.[1]) || 1000 * Number(/([\d.]+) MB$/.exec(size)?.[1]);
      assert.ok(format === "png" ? size === "" : Math.abs(1000 * kilobytes - direct.bytes.length) < 0.5 * direct.bytes.length, `${size}: ${direct.bytes.length} bytes`);
      const other = await fetchBytes(`${structure}/surface.${format}?resolution=0.9`);
      assert.ok(!other.bytes.equals(direct.bytes), "meshes of different resolution are equal");
    }
    // Parameters of pictures change neither the mesh nor the other files.
    const before = await meshesShown(page);
    await page.locator("details.more", { has: page.locator("#picture-fields") }).locator("summary").click();
    await page.locator("#p-width").fill("300");
    await page.locator("#p-width").press("Enter");
    await page.locator("#format").selectOption("png");
    await page.locator("#curl", { hasText: "width=300" }).waitFor();
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="png"]').click()]);
    const png = readFileSync(await download.path());
    assert.deepEqual([png.readUInt32BE(16), png.readUInt32BE(20)], [300, 512]);
    await page.locator("#format").selectOption("glb");
    assert.ok(!(await page.locator("#curl").textContent()).includes("width"));
    assert.equal(await meshesShown(page), before);
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "the page has a light and a dark theme": async () => {
    const light = silhouette(await picture(page)).background;
    await page.emulateMedia({ colorScheme: "dark", reducedMotion: "reduce" });
    const dark = silhouette(await picture(page)).background;
    assert.ok(light > 0.8 && dark < 0.15, `${light} ${dark}`);
    assert.deepEqual(await axe(page), []);
    await page.locator("#theme").click();
    assert.ok(silhouette(await picture(page)).background > 0.8, "the button overrides the system setting");
    assert.deepEqual(await axe(page), []);
    await page.emulateMedia({ colorScheme: "light", reducedMotion: "reduce" });
    await page.locator("#theme").click();
    assert.ok(silhouette(await picture(page)).background < 0.15);
    await page.locator("#theme").click();
  },

  "the page can be used with the keyboard alone": async () => {
    await page.reload({ timeout: TIMEOUT_MS });
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    await page.waitForFunction(() => !document.querySelector("#colour").disabled);
    const focused = () => page.evaluate(() => document.activeElement.id || document.activeElement.dataset.slider || document.activeElement.className);
    const reach = async (id) => {
      for (let i = 0; i < 80; i += 1) {
        await page.keyboard.press("Tab");
        if ((await focused()) === id) return;
      }
      assert.fail(`the Tab key does not reach ${id}`);
    };
    await page.keyboard.press("Tab");
    assert.equal(await focused(), "skip");
    await reach("view-home");
    const before = await picture(page);
    await page.keyboard.press("ArrowLeft");
    await page.keyboard.press("+");
    const after = await picture(page);
    assert.ok(after.data.filter((v, i) => Math.abs(v - before.data[i]) > 20).length > 2000, "arrow keys turn the surface");
    await page.keyboard.press("Home");
    await page.keyboard.press("Enter");
    assert.match(await pinned(page), /of the file/);
    await page.keyboard.press("Escape");
    await reach("isovalue");
    await waitForMesh(page, () => page.keyboard.press("ArrowRight"));
    await page.waitForFunction(() => /Surface of 4PTI/.test(document.querySelector("#live").textContent));
    await reach("copy-curl");
  },

  "the surface turns only if the user allows motion": async () => {
    await stablePicture(page);
    // The initial turn starts and ends by itself, so an observer records it.
    const other = await start(chromium, {
      url: `${SERVICE_URL}/?resolution=1.5`,
      reducedMotion: "no-preference",
      viewport: { width: 320, height: 400 },
      before: (p) => p.addInitScript(() => new MutationObserver(() => (window.turned ||= !!document.querySelector('#turn[aria-pressed="true"]'))).observe(document, { subtree: true, childList: true, attributes: true })),
    });
    await other.waitForFunction(() => window.turned);
    const turn = other.locator("#turn");
    // A turn that the user starts does not end by itself.
    while ((await turn.getAttribute("aria-pressed")) === "true") await turn.click();
    await turn.click();
    assert.equal(await turn.getAttribute("aria-pressed"), "true");
    const turning = [await picture(other), await picture(other)];
    assert.ok(!turning[0].data.equals(turning[1].data));
    await turn.click();
    assert.equal(await turn.getAttribute("aria-pressed"), "false");
    await stablePicture(other);
    assertClean(other);
    await other.context().close();
  },

  "the page fits a phone": async () => {
    const phone = await start(chromium, { viewport: { width: 375, height: 812 }, hasTouch: true, isMobile: true });
    assert.ok((await phone.evaluate(() => document.documentElement.scrollWidth)) <= 375);
    await phone.locator("#parameters details.more summary").tap();
    assert.ok((await phone.evaluate(() => document.documentElement.scrollWidth)) <= 375);
    assert.deepEqual(await axe(phone), []);
    assert.ok(silhouette(await picture(phone)).share > 0.1);
    assertClean(phone);
    await phone.context().close();
  },

  "a lost WebGL context gives a message, and the surface returns after it is restored": async () => {
    const png = (await fetchBytes(uncompressed(path(surfaces(page).at(-1))).replace("surface.glb", "surface.png").replace("atom_ids=true&", ""))).status === 200;
    await page.evaluate(() => {
      window.lose = document.querySelector("#view").getContext("webgl2").getExtension("WEBGL_lose_context");
      window.lose.loseContext();
    });
    await page.locator("#no-webgl").waitFor();
    assert.match(await page.locator("#no-webgl").textContent(), /graphics device was lost/);
    if (png) await page.locator("#picture").waitFor();
    else await page.locator("#no-webgl .hint").waitFor();
    await page.evaluate(() => window.lose.restoreContext());
    await page.locator("#no-webgl").waitFor({ state: "hidden" });
    await waitForMesh(page, () => page.locator("#reset-all").click());
    await page.locator("#home").click();
    assert.equal(pictureFault(await picture(page), await meshOf(page), await plainColor(page)), null);
  },

  "meshes are compressed and decoded under the content security policy, unless the user chooses otherwise": async () => {
    const isDecoder = (line) => line.includes("/assets/meshopt");
    assert.ok(page.requests.some(isDecoder));
    assert.match(surfaces(page)[0], /compress=meshopt/);
    assert.ok(!page.url().includes("compress") && !(await page.locator("#curl").textContent()).includes("compress"));
    // Several pieces are one surface, which is not divided.
    const fine = await start(chromium, { url: `${SERVICE_URL}/?resolution=0.3` });
    const { json } = glb((await fetchBytes(path(surfaces(fine).at(-1)))).bytes);
    assert.ok(json.meshes.length === 1 && json.meshes[0].primitives.length > 1);
    assert.ok(await fine.locator("#parts").isHidden());
    assert.equal(pictureFault(await picture(fine), await meshOf(fine), await plainColor(fine)), null);
    assertClean(fine);
    await fine.context().close();
    for (const compress of ["none", "quantize"]) {
      const other = await start(chromium, { url: `${SERVICE_URL}/?compress=${compress}` });
      assert.equal(pictureFault(await picture(other), await meshOf(page), await plainColor(page)), null);
      assert.match(surfaces(other).at(-1), new RegExp(`compress=${compress}`));
      assert.ok(!other.requests.some(isDecoder), "the decoder was loaded without need");
      assertClean(other);
      await other.context().close();
    }
  },

  "the page has no errors and sent requests to the service alone": async () => {
    // The browser logs rejected requests and the lost context of the test above.
    assertClean(page, /Failed to load resource/, /CONTEXT_LOST|Context Lost|Context Restored|does not belong to this context/i);
    assert.ok(page.requests.length > 40);
  },
});
