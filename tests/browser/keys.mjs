// A service that requires an API key.
import { assert, assertClean, axe, browser, open, run, TIMEOUT_MS } from "./lib.mjs";

const chromium = await browser();
const page = await open(chromium);

await run({
  "the page asks for a key": async () => {
    await page.locator("#key-form").waitFor();
    assert.ok(await page.locator("#problem").isHidden());
    assert.deepEqual(await axe(page), []);
  },
  "an unknown key is rejected with the message of the service": async () => {
    await page.locator("#key").fill("mm_wrong");
    await page.locator("#key").press("Enter");
    await page.locator("#problem strong").waitFor();
    assert.match(await page.locator("#problem").textContent(), /key is unknown/);
  },
  "the page works with the key and does not store it": async () => {
    await page.locator("#key").fill(process.env.MOLMESH_KEY);
    await page.locator("#key").press("Enter");
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    assert.ok(await page.locator("#key-form").isHidden());
    await page.waitForFunction(() => !document.querySelector("#colour").disabled, null, { timeout: TIMEOUT_MS });
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="stl"]').click()]);
    assert.ok((await download.suggestedFilename()).endsWith(".stl"));
    assert.match(await page.locator("#curl").textContent(), /X-Api-Key: \$MOLMESH_KEY/);
    const stored = await page.evaluate(() => JSON.stringify([localStorage, sessionStorage, document.cookie, location.href]));
    assert.ok(!stored.includes(process.env.MOLMESH_KEY));
    await page.reload({ timeout: TIMEOUT_MS });
    await page.locator("#key-form").waitFor();
    assertClean(page, /401 \(Unauthorized\)/);
  },
});
