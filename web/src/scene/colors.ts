/** Colours of chains and elements, distinct in hue and lightness, also with colour vision deficiency. */

import { Color } from "three";

const CHAINS = ["#4fa59b", "#e08e5a", "#7f8fd0", "#c9ad4b", "#c56d98", "#77a952", "#5a9fd4", "#b98a6a", "#9a7cc4", "#cf6b63", "#5cb8b2", "#98a2ad"];
const ELEMENTS: Record<string, string> = {
  H: "#e8e8e8", C: "#a6b0b8", N: "#6f8fe0", O: "#e0685f", S: "#dcc04a", P: "#e39a4f", F: "#8ccf7e", CL: "#6fc36a",
  BR: "#b0614a", I: "#8a5bb0", NA: "#9a7ad0", MG: "#7bbf62", K: "#8a63c8", CA: "#79b36a", FE: "#d07a4a", ZN: "#8b90b5",
  MN: "#9a7fc0", CU: "#c98550", NI: "#6fb57a", CO: "#d98aa0", SE: "#d9a04a",
};

export function chainColors(names: string[]): Color[] {
  return names.map((_, i) => new Color(CHAINS[i % CHAINS.length]));
}

export function elementColors(names: string[]): Color[] {
  return names.map((name) => new Color(ELEMENTS[name.toUpperCase()] ?? "#c98bb9"));
}
