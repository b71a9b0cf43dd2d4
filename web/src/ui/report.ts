/** Report of the shown surface, first from the file, later from the service's report. */

import type { Client } from "../../client/src/client";
import { el, number } from "./dom";

export type Report = Record<string, unknown>;

const UNITS: Record<string, string> = { area: "Å²", volume: "Å³", resolution: "Å" };
const ROWS = ["atoms", "triangles", "vertices", "area", "volume", "components", "voids", "euler", "resolution", "isovalue", "smoothness", "surface", "probe", "preset"];
const CHECKS = ["closed", "oriented", "manifold"];

/** Writes a report; `timings` are pairs of stage and ms. */
export function report(home: HTMLElement, document: Report, timings: [string, number][]): void {
  const isOpen = home.querySelector("details")?.open ?? false;
  const checks = CHECKS.filter((name) => typeof document[name] === "boolean").map((name) => {
    const yes = document[name] === true;
    return el("span", { class: yes ? "yes" : "no" }, `${yes ? "✓" : "✗ not"} ${name}`);
  });
  const rows = ROWS.filter((name) => document[name] !== undefined && document[name] !== null).map((name) => {
    const value = document[name];
    const text = typeof value === "number" ? `${number(value, 5)} ${UNITS[name] ?? ""}` : String(value);
    const from = name === "resolution" && document["resolution_from"] !== "resolution" && document["resolution_from"] ? ` (from ${String(document["resolution_from"]).replaceAll("_", " ")})` : "";
    return el("tr", { "data-row": name }, el("th", { scope: "row" }, name === "euler" ? "Euler number" : name), el("td", {}, `${text.trim()}${from}`));
  });
  const device = document["device"] ?? document["backend"];
  const parts: Node[] = [el("div", { class: "checks" }, ...checks), el("table", {}, el("tbody", {}, ...rows))];
  if (device) parts.push(el("p", { class: "why" }, el("b", {}, String(document["backend"] ?? "")), ` ${String(document["device"] ?? "")}`, ...(document["backend_reason"] ? [` (${String(document["backend_reason"])})`] : [])));
  if (document["fallback"]) parts.push(el("p", { class: "why" }, `Fallback: ${String(document["fallback"])}`));
  if (timings.length) {
    const longest = Math.max(...timings.map(([, ms]) => ms), 1e-3);
    const bars = timings.map(([stage, ms]) =>
      el("tr", {}, el("th", { scope: "row" }, stage), el("td", {}, el("meter", { min: 0, max: longest, value: ms, "aria-label": `${stage}: ${ms.toFixed(2)} ms` })), el("td", {}, `${ms.toFixed(2)} ms`)),
    );
    const total = timings.reduce((sum, [, ms]) => sum + ms, 0);
    const details = el("details", { class: "times" }, el("summary", {}, `Time per stage: ${total.toFixed(1)} ms`), el("table", {}, el("tbody", {}, ...bars)));
    details.open = isOpen;
    parts.push(details);
  }
  home.replaceChildren(...parts);
}

/** Fetches the report of a result. Null if the result is not stored; then the page shows the report in the file. */
export async function storedReport(client: Client, headers: Headers, signal: AbortSignal): Promise<Report | null> {
  const key = /\/v1\/results\/([0-9a-f]{64})\./.exec(headers.get("content-location") ?? "")?.[1];
  return key ? client.json<Report>(`/v1/results/${key}/report.json`, { signal }).catch(() => null) : null;
}

/** Returns what a coarse tile has in common with the whole surface, with `measures` in place of area and volume. */
export function sharedReport(tile: Report, measures: string): Report {
  const shared = ["atoms", "isovalue", "smoothness", "surface", "probe", "preset"].map((name) => [name, tile[name]]);
  return { ...Object.fromEntries(shared), triangles: measures, area: measures, volume: measures };
}

/** Returns the stage times of a report, or of `Server-Timing`, ms. */
export function timingsOf(headers: Headers, document?: Report): [string, number][] {
  const timings = document?.["timings_ms"];
  if (timings && typeof timings === "object") return Object.entries(timings as Record<string, number>);
  const entries = (headers.get("server-timing") ?? "").split(", ").map((entry) => entry.split(";dur="));
  return entries.filter((entry) => entry.length === 2 && entry[0] !== "total").map(([name, ms]) => [name ?? "", Number(ms)]);
}
