// A service that asks for a key.
import { assert, axe, browser, clean, open, run, PATIENCE } from "./lib.mjs";

const chromium = await browser();
const page = await open(chromium);

await run({
  "a key is asked for": async () => {
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
  "with the key everything works, and it is kept nowhere": async () => {
    await page.locator("#key").fill(process.env.MOLMESH_KEY);
    await page.locator("#key").press("Enter");
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    assert.ok(await page.locator("#key-form").isHidden());
    await page.waitForFunction(() => !document.querySelector("#colour").disabled, null, { timeout: PATIENCE });
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="stl"]').click()]);
    assert.ok((await download.suggestedFilename()).endsWith(".stl"));
    assert.match(await page.locator("#curl").textContent(), /X-Api-Key: \$MOLMESH_KEY/);
    const kept = await page.evaluate(() => JSON.stringify([localStorage, sessionStorage, document.cookie, location.href]));
    assert.ok(!kept.includes(process.env.MOLMESH_KEY));
    await page.reload({ timeout: PATIENCE });
    await page.locator("#key-form").waitFor();
    clean(page, /401 \(Unauthorized\)/);
  },
});
