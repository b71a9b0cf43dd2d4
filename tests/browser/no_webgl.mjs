// A browser without WebGL: the page shows a message and a picture that the service renders.
import { assert, assertClean, axe, browser, deferred, fetchBytes, open, reportValue, run, slide, waitForMesh, TIMEOUT_MS } from "./lib.mjs";

const chromium = await browser("--disable-3d-apis");
const page = await open(chromium);

await run({
  "a message and a picture are shown": async () => {
    await page.locator("#no-webgl").waitFor();
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    const pictures = () => page.requests.filter((line) => line.includes("/surface.png")).map((line) => line.slice(line.indexOf("/v1/")));
    assert.match(await page.locator("#no-webgl").textContent(), /no WebGL/);
    await page.waitForFunction(() => !document.querySelector("#picture").hidden || document.querySelector("#no-webgl .hint:not([hidden])"), null, { timeout: TIMEOUT_MS });
    const direct = await fetchBytes(pictures()[0]);
    if (direct.status === 200) {
      assert.ok(await page.locator("#picture").isVisible());
      assert.ok((await page.locator("#picture").evaluate((image) => image.naturalWidth)) > 100);
    } else assert.match(await page.locator("#no-webgl").textContent(), /does not render pictures/);
    assert.ok((await reportValue(page, "triangles")) > 10_000, "no report");
    const before = pictures().length;
    await waitForMesh(page, () => slide(page, "isovalue", 400));
    assert.ok(pictures().length > before && pictures().at(-1).includes("isovalue="), "no new picture was requested");
    assert.ok(await page.locator("#turn").isHidden());
    assert.deepEqual(await axe(page), []);
  },

  "the picture and its description change together": async () => {
    const picture = page.locator("#picture");
    const image = () => picture.evaluate((node) => (node.hidden ? null : `${node.src} ${node.alt}`));
    const hint = page.locator("#no-webgl .hint");
    const before = await image();
    assert.match(before, /4PTI/);
    const [requested, released] = [deferred(), deferred()];
    await page.route(/1crn\/surface\.png/, async (route) => {
      requested.resolve();
      await released.promise;
      await route.continue();
    });
    await page.locator("#pdb").fill("1crn");
    await waitForMesh(page, async () => {
      await page.locator("#pdb").press("Enter");
      await requested.promise;
      assert.deepEqual([await image(), await page.locator("#structure-name").textContent()], [before, "4PTI"]);
      released.resolve();
    });
    assert.match(await image(), /1CRN/);
    // After a failed request the previous picture is hidden until the next one arrives.
    await page.unroute(/1crn\/surface\.png/);
    await page.route(/surface\.png.*isovalue=2/, (route) => route.fulfill({ status: 503, json: { type: "/problems/queue-full", title: "The queue is full", status: 503, detail: "The queue is full" } }));
    await page.locator("#p-isovalue").fill("2");
    await waitForMesh(page, () => page.locator("#p-isovalue").press("Enter"));
    assert.equal(await image(), null);
    assert.match(await hint.textContent(), /The queue is full/);
    await waitForMesh(page, () => page.locator("#reset-all").click());
    assert.match(await image(), /1CRN/);
    assert.ok(await hint.isHidden());
    assertClean(page, /Failed to load resource/);
  },
});
