// The page at `/`: what people see and do.
import { readFileSync } from "node:fs";
import {
  assert, axe, browser, clean, drop, emptied, fetched, inverted, looksWrong, open, picture, plainColor, remeshed, reported, run, sample, settled, shown, silhouette, slide, start, still, PATIENCE, URL_OF_SERVICE,
} from "./lib.mjs";

const chromium = await browser();
const page = await start(chromium);
const surfaces = (p) => p.asked.filter((line) => line.includes("/surface.glb"));
const path = (line) => line.slice(line.indexOf("/v1/"));
const meshOf = async (p) => (await fetched(path(surfaces(p).at(-1)))).bytes;
const atomsOf = (file) => readFileSync(sample(file), "utf8").split("\n").filter((l) => /^(ATOM|HETATM)/.test(l));
const pinned = (p) => p.locator("#picked").textContent();

await run({
  "the sample is there at once, with its report": async () => {
    assert.equal(await page.locator("#structure-name").textContent(), "4PTI");
    const { headers } = await fetched(path(surfaces(page)[0]));
    assert.equal(await reported(page, "triangles"), Number(headers.get("molmesh-triangles")));
    assert.ok(Math.abs((await reported(page, "area")) - Number(headers.get("molmesh-area"))) < 0.1);
    assert.match(await page.locator("#report .proof").textContent(), /✓ closed/);
    // What differs from run to run comes with the service's own report.
    await page.locator("#report .why", { hasText: /cpu.*thread.* \(/ }).waitFor();
    assert.ok((await page.locator("#report .times tr").count()) >= 5, "stages with their times");
  },

  "the surface is seen from outside, and blank or inverted ones are noticed": async () => {
    const plain = await plainColor(page);
    assert.equal(looksWrong(await picture(page), await meshOf(page), plain), null);
    for (const [change, words] of [[inverted, /dark/], [emptied, /silhouette/]]) {
      const other = await start(chromium, {
        before: (p) => p.route("**/surface.glb*", async (route) => {
          const reply = await route.fetch();
          await route.fulfill({ response: reply, body: change(await reply.body()) });
        }),
      });
      assert.match(looksWrong(await picture(other), await meshOf(page), plain) ?? "nothing", words);
      await other.context().close();
    }
  },

  "every parameter of the description has a control, and a new one gets one": async () => {
    const api = JSON.parse((await fetched("/openapi.json")).bytes);
    const parameter = (p) => (p.$ref ? api.components.parameters[p.$ref.split("/").pop()] : p);
    const names = (described) => described.paths["/v1/meshes"].post.parameters.map(parameter).filter((p) => p.in === "query" && p.name !== "format").map((p) => p.name);
    const controls = (p) => p.locator("[data-parameter]").evaluateAll((nodes) => nodes.map((n) => n.dataset.parameter).sort());
    assert.ok(names(api).length > 20);
    assert.deepEqual(await controls(page), names(api).sort());
    const parameters = api.paths["/v1/meshes"].post.parameters;
    parameters.push({ name: "wobble", in: "query", description: "How much it wobbles.", schema: { type: "number", minimum: 0, maximum: 1, default: 0.5 } });
    api.components.schemas.Surface.enum.push("cubic");
    const other = await start(chromium, { before: (p) => p.route("**/openapi.json", (route) => route.fulfill({ json: api })) });
    assert.deepEqual(await controls(other), names(api).sort());
    assert.ok((await other.locator("#p-surface option").allTextContents()).includes("cubic"));
    // The service does not know it, and says so; the page offers to take it back.
    await other.locator("#parameters details.more summary").click();
    await slide(other, "wobble", 800);
    await other.locator("#problem strong").waitFor();
    assert.ok(surfaces(other).at(-1).includes("wobble=0.8"), surfaces(other).at(-1));
    assert.match(await other.locator("#problem").textContent(), /unknown parameter `wobble`/);
    await remeshed(other, () => other.getByRole("button", { name: "Reset wobble", exact: true }).click());
    assert.ok(await other.locator("#problem").isHidden());
    clean(other, /400 \(Bad Request\)/);
    await other.context().close();
  },

  "a slider re-meshes, the latest one wins and what it supersedes is cancelled": async () => {
    let release;
    const held = new Promise((resolve) => (release = resolve));
    const failed = [];
    page.on("requestfailed", (request) => failed.push(`${request.url()} ${request.failure().errorText}`));
    await page.route(/surface\.glb.*isovalue=2/, async (route) => {
      await held;
      await route.continue().catch(() => undefined);
    });
    const before = await shown(page);
    await page.locator("#p-isovalue").fill("2");
    await Promise.all([page.waitForRequest(/isovalue=2&/), page.locator("#p-isovalue").press("Enter")]);
    await remeshed(page, () => slide(page, "isovalue", 400));
    const last = Number(/isovalue=([\d.]+)/.exec(surfaces(page).at(-1))[1]);
    assert.ok(failed.some((line) => /isovalue=2(&| ).*ERR_ABORTED/.test(line)), `${failed}`);
    release();
    await settled(page);
    assert.equal(await shown(page), before + 1);
    assert.equal(await reported(page, "isovalue"), last);
    assert.ok(last > 0.2 && last < 1, `${last}`);
    await page.unroute(/surface\.glb.*isovalue=2/);
  },

  "what is set lasts when the page is reloaded, and can be taken back": async () => {
    await remeshed(page, () => page.locator("#p-preset").selectOption("ses-like"));
    const asked = path(surfaces(page).at(-1));
    assert.match(asked, /preset=ses-like/);
    assert.match(await page.locator("#curl").textContent(), /preset=ses-like/);
    await page.reload({ timeout: PATIENCE });
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    assert.equal(path(surfaces(page).at(-1)), asked);
    assert.equal(await page.locator("#p-preset").inputValue(), "ses-like");
    await remeshed(page, () => page.locator("#reset-all").click());
    assert.ok(!surfaces(page).at(-1).includes("preset"));
  },

  "a dropped file is uploaded once and meshed": async () => {
    const posts = () => page.asked.filter((line) => line.startsWith("POST")).length;
    const before = posts();
    await remeshed(page, () => drop(page, "1crn.cif", readFileSync(sample("1crn.cif"))));
    assert.equal(await page.locator("#structure-name").textContent(), "1CRN");
    await remeshed(page, () => slide(page, "smoothness", 300));
    assert.equal(posts(), before + 1);
    assert.match(await page.locator("#curl").textContent(), /--data-binary @1crn.cif/);
    await remeshed(page, () => page.setInputFiles("#file", sample("4pti.pdb")));
    assert.equal(await page.locator("#structure-name").textContent(), "4PTI");
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "picking names the atom that the file has there": async () => {
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
    // A residue that sticks out is turned to the front: the atom in the middle is one of it, or a neighbour's.
    await page.locator("#find").fill("A LYS 15");
    await page.locator("#find").press("Enter");
    assert.match(await pinned(page), /^LYS 15 · CA/);
    await place.focus();
    await page.keyboard.press("Enter");
    assert.match(await pinned(page), /^LYS 15 ·/);
    // Pointing is enough to be told, and what is marked is seen.
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

  "every format is downloaded as its address gives it": async () => {
    await remeshed(page, () => page.locator("#p-resolution").fill("0.8").then(() => page.locator("#p-resolution").press("Enter")));
    const structure = /\/v1\/structures\/[0-9a-f]+/.exec(surfaces(page).at(-1))[0];
    const formats = await page.locator("#formats button").evaluateAll((nodes) => nodes.map((n) => n.dataset.format));
    const can = JSON.parse((await fetched("/v1/capabilities")).bytes);
    assert.deepEqual(formats, can.formats.map((f) => f.name));
    for (const format of formats) {
      const [download] = await Promise.all([page.waitForEvent("download"), page.locator(`#formats button[data-format="${format}"]`).click()]);
      assert.equal(download.suggestedFilename(), format === "ply-text" ? "4PTI.ply" : `4PTI.${format}`);
      const direct = await fetched(`${structure}/surface.${format}?resolution=0.8`);
      assert.equal(direct.status, 200);
      assert.ok(readFileSync(await download.path()).equals(direct.bytes), format);
      const other = await fetched(`${structure}/surface.${format}?resolution=0.9`);
      assert.ok(!other.bytes.equals(direct.bytes), "two meshes are the same");
    }
    // What goes with a picture alone changes neither the mesh nor the other files.
    const before = await shown(page);
    await page.locator("details.more", { has: page.locator("#picture-fields") }).locator("summary").click();
    await page.locator("#p-width").fill("300");
    await page.locator("#p-width").press("Enter");
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="png"]').click()]);
    const png = readFileSync(await download.path());
    assert.deepEqual([png.readUInt32BE(16), png.readUInt32BE(20)], [300, 512]);
    assert.ok(!(await page.locator("#curl").textContent()).includes("width"));
    await page.locator("#format").selectOption("png");
    assert.match(await page.locator("#curl").textContent(), /width=300/);
    await page.locator("#format").selectOption("glb");
    assert.equal(await shown(page), before);
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "errors are said in the service's words, with a way on": async () => {
    const problem = page.locator("#problem");
    await page.locator("#p-resolution").fill("0.05");
    await page.locator("#p-resolution").press("Enter");
    await problem.locator("strong").waitFor();
    assert.match(await problem.textContent(), /The grid would be too large.*limit/);
    assert.deepEqual(await axe(page), []);
    await remeshed(page, () => problem.getByRole("button", { name: /^Take [\d.]+ Å$/ }).click());
    assert.ok(await problem.isHidden());
    const taken = Number(await page.locator("#p-resolution").inputValue());
    assert.ok(taken > 0.05 && taken < 0.5, `${taken}`);
    await remeshed(page, () => page.locator("#reset-all").click());
    // A spacing and a level of detail exclude each other: the later one stands.
    await remeshed(page, () => slide(page, "resolution", 700));
    await page.locator("#parameters details.more").evaluate((node) => (node.open = true));
    await remeshed(page, () => slide(page, "detail", 2));
    assert.ok(/detail=2/.test(surfaces(page).at(-1)) && !/resolution=/.test(surfaces(page).at(-1)), surfaces(page).at(-1));
    await remeshed(page, () => page.locator("#reset-all").click());
    await page.locator("#p-altloc").fill("too long");
    await page.locator("#p-altloc").press("Enter");
    await problem.locator("strong").waitFor();
    assert.match(await problem.textContent(), /A parameter cannot be used.*one character/s);
    await remeshed(page, () => problem.getByRole("button", { name: "Reset altloc", exact: true }).click());
    await drop(page, "poem.txt", Buffer.from("Whose woods these are I think I know"));
    await problem.locator("strong").waitFor();
    assert.match(await problem.textContent(), /The structure cannot be read/);
    await problem.getByRole("button", { name: "Close" }).click();
    // The archive has one entry, and no other.
    await page.locator("#pdb").fill("9xyz");
    await page.locator("#pdb").press("Enter");
    await problem.locator("strong").waitFor();
    assert.match(await problem.textContent(), /The archive has no such entry/);
    await page.locator("#pdb").fill("1crn");
    await remeshed(page, () => page.locator("#pdb").press("Enter"));
    assert.equal(await page.locator("#structure-name").textContent(), "1CRN");
    assert.match(await page.locator("#curl").textContent(), /\/v1\/pdb\/1crn\/surface\.glb/);
    await page.waitForFunction(() => !document.querySelector("#colour").disabled);
    await remeshed(page, () => page.locator("#sample").click());
  },

  "without the service it says so, and goes on when it is back": async () => {
    await page.context().setOffline(true);
    await slide(page, "isovalue", 600);
    await page.locator("#problem strong").waitFor();
    assert.match(await page.locator("#problem").textContent(), /cannot be reached/);
    await page.context().setOffline(false);
    await remeshed(page, () => page.getByRole("button", { name: "Try again" }).click());
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "light and dark": async () => {
    const light = silhouette(await picture(page)).background;
    await page.emulateMedia({ colorScheme: "dark", reducedMotion: "reduce" });
    const dark = silhouette(await picture(page)).background;
    assert.ok(light > 0.8 && dark < 0.15, `${light} ${dark}`);
    assert.deepEqual(await axe(page), []);
    await page.locator("#theme").click();
    assert.ok(silhouette(await picture(page)).background > 0.8, "the button overrules the system");
    assert.deepEqual(await axe(page), []);
    await page.emulateMedia({ colorScheme: "light", reducedMotion: "reduce" });
    await page.locator("#theme").click();
    assert.ok(silhouette(await picture(page)).background < 0.15);
    await page.locator("#theme").click();
  },

  "the keyboard is enough": async () => {
    await page.reload({ timeout: PATIENCE });
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    await page.waitForFunction(() => !document.querySelector("#colour").disabled);
    const focused = () => page.evaluate(() => document.activeElement.id || document.activeElement.dataset.slider || document.activeElement.className);
    const reach = async (id) => {
      for (let i = 0; i < 80; i += 1) {
        await page.keyboard.press("Tab");
        if ((await focused()) === id) return;
      }
      assert.fail(`the Tab key does not lead to ${id}`);
    };
    await page.keyboard.press("Tab");
    assert.equal(await focused(), "skip");
    await reach("view-home");
    const before = await picture(page);
    await page.keyboard.press("ArrowLeft");
    await page.keyboard.press("+");
    const after = await picture(page);
    assert.ok(after.data.filter((v, i) => Math.abs(v - before.data[i]) > 20).length > 2000, "arrows turn it");
    await page.keyboard.press("Home");
    await page.keyboard.press("Enter");
    assert.match(await pinned(page), /of the file/);
    await page.keyboard.press("Escape");
    await reach("isovalue");
    await remeshed(page, () => page.keyboard.press("ArrowRight"));
    await page.waitForFunction(() => /Surface of 4PTI/.test(document.querySelector("#live").textContent));
    await reach("copy-curl");
  },

  "nothing moves for those who want no motion, and the molecule turns for others": async () => {
    await still(page);
    // It begins by itself, and ends by itself: what is noted does not go away.
    const other = await start(chromium, {
      reducedMotion: "no-preference",
      viewport: { width: 500, height: 500 },
      before: (p) => p.addInitScript(() => new MutationObserver(() => (window.turned ||= !!document.querySelector('#turn[aria-pressed="true"]'))).observe(document, { subtree: true, childList: true, attributes: true })),
    });
    await other.waitForFunction(() => window.turned);
    const turn = other.locator("#turn");
    // Once asked for, it goes on.
    while ((await turn.getAttribute("aria-pressed")) === "true") await turn.click();
    await turn.click();
    assert.equal(await turn.getAttribute("aria-pressed"), "true");
    const turning = [await picture(other), await picture(other)];
    assert.ok(!turning[0].data.equals(turning[1].data));
    await turn.click();
    assert.equal(await turn.getAttribute("aria-pressed"), "false");
    await still(other);
    clean(other);
    await other.context().close();
  },

  "it fits a phone": async () => {
    const phone = await start(chromium, { viewport: { width: 375, height: 812 }, hasTouch: true, isMobile: true });
    assert.ok((await phone.evaluate(() => document.documentElement.scrollWidth)) <= 375);
    await phone.locator("#parameters details.more summary").tap();
    assert.ok((await phone.evaluate(() => document.documentElement.scrollWidth)) <= 375);
    assert.deepEqual(await axe(phone), []);
    assert.ok(silhouette(await picture(phone)).share > 0.1);
    clean(phone);
    await phone.context().close();
  },

  "a lost context is said, and the surface comes back": async () => {
    const png = (await fetched(path(surfaces(page).at(-1)).replace("surface.glb", "surface.png").replace("?atom_ids=true", ""))).status === 200;
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
    await remeshed(page, () => page.locator("#reset-all").click());
    await page.locator("#home").click();
    assert.equal(looksWrong(await picture(page), await meshOf(page), await plainColor(page)), null);
  },

  "meshes that are compressed with meshopt are shown under the page's policy": async () => {
    const { packed } = await import("./meshopt.mjs");
    const other = await start(chromium, {
      before: (p) => p.route("**/surface.glb*", async (route) => {
        const reply = await route.fetch();
        await route.fulfill({ response: reply, body: await packed(await reply.body()) });
      }),
    });
    assert.equal(looksWrong(await picture(other), await meshOf(page), await plainColor(page)), null);
    assert.ok(other.asked.some((line) => line.includes("meshopt")));
    assert.ok(!page.asked.some((line) => line.includes("meshopt")), "it is loaded only where it is needed");
    clean(other);
    await other.context().close();
  },

  "nothing went wrong, and nobody else was asked": async () => {
    // What the service refuses the browser notes by itself, and what was held back or lost was so on purpose.
    clean(page, /Failed to load resource/, /CONTEXT_LOST|Context Lost|Context Restored|does not belong to this context/i);
    assert.ok(page.asked.length > 40);
  },
});
