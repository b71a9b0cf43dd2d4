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
    await page.waitForFunction(() => !document.querySelector("#picture").hidden || document.querySelector("#no-webgl .hint"), null, { timeout: PATIENCE });
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
    clean(page, ...(direct.status === 200 ? [] : [/Failed to load resource/]));
  },
});
