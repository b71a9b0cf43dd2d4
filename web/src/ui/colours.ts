/** Controls of the colours on the page: scheme, single colour, palette, and the legend. */

import { labelOf, type Legend } from "../api/colors";
import type { Schemes } from "../api/schema";
import type { Choices } from "../request";
import { $, el, show } from "./dom";
import { chooseScheme, showLegend } from "./legend";

/** Start of the schemes with a single colour. */
const UNIFORM = "uniform:";

export class ColourControls {
  private readonly scheme = $<HTMLSelectElement>("colour");
  private readonly single = $<HTMLInputElement>("single-colour");
  private readonly palette = $<HTMLSelectElement>("palette");

  constructor(recolour: (scheme: string) => void, setPalette: (palette: string) => void) {
    const uniform = () => UNIFORM + this.single.value;
    const chosen = () => (this.scheme.value === UNIFORM ? uniform() : this.scheme.value);
    this.scheme.addEventListener("change", () => recolour(chosen()));
    this.single.addEventListener("change", () => recolour(uniform()));
    this.palette.addEventListener("change", () => setPalette(this.palette.value));
  }

  /** Fills the menus. */
  fill({ all, palettes }: Schemes): void {
    const values = all.map((value) => (value.startsWith(UNIFORM) ? UNIFORM : value));
    this.scheme.replaceChildren(...values.map((value) => el("option", { value }, labelOf(value))));
    this.palette.replaceChildren(...palettes.map((value) => el("option", { value }, value)));
  }

  /** Shows the scheme of the surface. */
  choose(choices: Choices): void {
    const scheme = choices.get("color") ?? "none";
    const isSingle = scheme.startsWith(UNIFORM);
    chooseScheme(this.scheme, isSingle ? UNIFORM : scheme);
    show(this.single, isSingle);
    if (isSingle) this.single.value = `#${scheme.slice(UNIFORM.length).replace("#", "").toLowerCase()}`;
  }

  /** Shows the legend of the surface, and the palettes if the scheme has one. */
  explain(legend: Legend | null): void {
    showLegend($("legend"), legend);
    show(this.palette, legend?.palette !== undefined);
    if (legend?.palette) this.palette.value = legend.palette;
    show($("colours"), !$("legend").hidden);
  }
}
