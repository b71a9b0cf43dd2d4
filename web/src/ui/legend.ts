/** Menu of the colour schemes and legend of the colours, for the page and the component. */

import { type Legend, SCHEMES } from "../api/colors";
import { el } from "./dom";

/** Fills a menu with the colour schemes. */
export function fillSchemes(menu: HTMLSelectElement): void {
  menu.replaceChildren(...SCHEMES.map(([value, name]) => el("option", { value }, name)));
}

/** Selects a scheme in the menu. Adds an entry for a scheme that the menu lacks, such as `uniform:#58ad9d`. */
export function chooseScheme(menu: HTMLSelectElement, scheme: string): void {
  if (![...menu.options].some((option) => option.value === scheme)) menu.append(el("option", { value: scheme }, scheme));
  menu.value = scheme;
}

/** Shows the legend in `home`, or hides `home` if there is none. */
export function showLegend(home: HTMLElement, legend: Legend | null): void {
  const entries = legend?.legend ?? [];
  home.hidden = entries.length === 0;
  home.replaceChildren(...(legend?.range ? scale(legend) : entries.map(({ label, color }) => el("span", { class: "entry" }, swatch(color), label || "(blank)"))));
}

function swatch(color: string): HTMLElement {
  const node = el("span", { class: "swatch", "aria-hidden": "true" });
  node.style.background = color;
  return node;
}

/** Returns a bar with the palette between the values at its ends. */
function scale({ scheme, range, legend }: Legend): Node[] {
  const bar = el("span", { class: "scale", role: "img", "aria-label": `Colours of ${scheme}, from low to high` });
  bar.style.background = `linear-gradient(to right, ${legend.map(({ color }) => color).join(", ")})`;
  const [low, high] = range ?? [0, 0];
  return [el("span", { class: "low" }, String(low)), bar, el("span", { class: "high" }, String(high))];
}
