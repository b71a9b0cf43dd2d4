// A browser without WebGL: a message, and the picture that the service draws.
import { assert, axe, browser, clean, fetched, open, remeshed, reported, run, slide, PATIENCE } from "./lib.mjs";

const chromium = await browser("--disable-3d-apis");
const page = await open(chromium);

await run({
  "it says so, and shows the picture": async () => {
    await page.locator("#no-webgl").waitFor();
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    const asked = () => page.asked.filter((line) => line.includes("/surface.png")).map((line) => line.slice(line.indexOf("/v1/")));
    assert.match(await page.locator("#no-webgl").textContent(), /no WebGL/);
    await page.waitForFunction(() => !document.querySelector("#picture").hidden || document.querySelector("#no-webgl .hint:not([hidden])"), null, { timeout: PATIENCE });
    const direct = await fetched(asked()[0]);
    if (direct.status === 200) {
      assert.ok(await page.locator("#picture").isVisible());
      assert.ok((await page.locator("#picture").evaluate((image) => image.naturalWidth)) > 100);
    } else assert.match(await page.locator("#no-webgl").textContent(), /draws no pictures/);
    assert.ok((await reported(page, "triangles")) > 10_000, "the report is there nevertheless");
    const before = asked().length;
    await remeshed(page, () => slide(page, "isovalue", 400));
    assert.ok(asked().length > before && asked().at(-1).includes("isovalue="), "the picture follows");
    assert.ok(await page.locator("#turn").isHidden());
    assert.deepEqual(await axe(page), []);
  },

  "the picture and what describes it change together": async () => {
    const picture = page.locator("#picture");
    const image = () => picture.evaluate((node) => (node.hidden ? null : `${node.src} ${node.alt}`));
    const hint = page.locator("#no-webgl .hint");
    const before = await image();
    assert.match(before, /4PTI/);
    let release, ask;
    const [held, asked] = [new Promise((resolve) => (release = resolve)), new Promise((resolve) => (ask = resolve))];
    await page.route(/1crn\/surface\.png/, async (route) => {
      ask();
      await held;
      await route.continue();
    });
    await page.locator("#pdb").fill("1crn");
    await remeshed(page, async () => {
      await page.locator("#pdb").press("Enter");
      await asked;
      assert.deepEqual([await image(), await page.locator("#structure-name").textContent()], [before, "4PTI"]);
      release();
    });
    assert.match(await image(), /1CRN/);
    // A picture that cannot be had takes the former one away, until there is another.
    await page.unroute(/1crn\/surface\.png/);
    await page.route(/surface\.png.*isovalue=2/, (route) => route.fulfill({ status: 503, json: { type: "/problems/queue-full", title: "The queue is full", status: 503, detail: "The queue is full" } }));
    await page.locator("#p-isovalue").fill("2");
    await remeshed(page, () => page.locator("#p-isovalue").press("Enter"));
    assert.equal(await image(), null);
    assert.match(await hint.textContent(), /The queue is full/);
    await remeshed(page, () => page.locator("#reset-all").click());
    assert.match(await image(), /1CRN/);
    assert.ok(await hint.isHidden());
    clean(page, /Failed to load resource/);
  },
});
