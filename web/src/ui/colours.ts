/** Controls of the colours on the page: scheme, single colour, palette, and the legend. */

import { labelOf, type Legend } from "../api/colors";
import type { Schemes } from "../api/schema";
import type { Choices } from "../rules";
import { $, el, show } from "./dom";
import { chooseScheme, showLegend } from "./legend";

/** Start of the schemes with a single colour. */
const UNIFORM = "uniform:";

export class ColourControls {
  private readonly scheme = $<HTMLSelectElement>("colour");
  private readonly single = $<HTMLInputElement>("single-colour");
  private readonly palette = $<HTMLSelectElement>("palette");

  constructor({ all, palettes }: Schemes, set: (name: string, value: string | undefined) => void) {
    const values = all.map((value) => (value.startsWith(UNIFORM) ? UNIFORM : value));
    this.scheme.replaceChildren(...values.map((value) => el("option", { value }, labelOf(value))));
    this.palette.replaceChildren(...palettes.map((value) => el("option", { value }, value)));
    const chosen = (scheme: string) => (scheme === "none" ? undefined : scheme === UNIFORM ? UNIFORM + this.single.value : scheme);
    this.scheme.onchange = () => set("color", chosen(this.scheme.value));
    this.single.onchange = () => set("color", chosen(UNIFORM));
    this.palette.onchange = () => set("palette", this.palette.value);
  }

  /** Shows the scheme and the palette of the parameters, and the legend of the surface. */
  render(choices: Choices, legend: Legend | null): void {
    const scheme = choices.get("color") ?? "none";
    const isSingle = scheme.startsWith(UNIFORM);
    chooseScheme(this.scheme, isSingle ? UNIFORM : scheme);
    show(this.single, isSingle);
    if (isSingle) this.single.value = `#${scheme.slice(UNIFORM.length).replace("#", "").toLowerCase()}`;
    showLegend($("legend"), legend);
    show(this.palette, legend?.palette !== undefined);
    this.palette.value = choices.get("palette") ?? legend?.palette ?? "";
    show($("colours"), !$("legend").hidden);
  }
}
