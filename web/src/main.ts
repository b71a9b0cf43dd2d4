/** Entry point of the page: structure and parameters, the surface, and its report. */

import { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import { asProblem } from "./api/problem";
import { formatsOf, type OpenApi, parametersOf, schemesOf, tilesetParametersOf } from "./api/schema";
import { theme } from "./ui/theme";
import { Page } from "./page";
import { $, show } from "./ui/dom";

const client = new Client(document.baseURI, { retries: 0 });
const page = new Page(client);
theme(() => page.stage.theme());

/** Starts the page, again after a key was entered. */
async function begin(): Promise<void> {
  try {
    const [api, capabilities] = await Promise.all([
      client.json<OpenApi>("/openapi.json"),
      client.json<{ version: string; limits: Record<string, number>; backends: { name: string }[] }>("/v1/capabilities"),
    ]);
    show($("key-form"), false);
    $("version").textContent = `molmesh ${capabilities.version}, ${capabilities.backends.map((b) => b.name).join(", ")} backend`;
    page.start(parametersOf(api), formatsOf(api), schemesOf(api), tilesetParametersOf(api));
  } catch (error) {
    const problem = asProblem(error);
    const asksForKey = error instanceof Problem && [401, 403].includes(problem.document.status);
    show($("key-form"), asksForKey);
    if (asksForKey && !client.key) {
      $("structure-name").textContent = "API key required";
      $("structure-title").textContent = "The operator of this server provides keys.";
      $("key").focus();
    } else page.fail(problem, { view: null, again: () => void begin() });
  }
}

$("key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  client.key = $<HTMLInputElement>("key").value.trim();
  void begin();
});
void begin();
