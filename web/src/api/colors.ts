/** Colours of atoms, for recolouring a surface without requesting a new mesh. */

import { query } from "../request";
import type { Choices } from "../rules";
import type { Client } from "../../client/src/client";

export interface Legend {
  /** Colour scheme, a value of the parameter `color`. */
  scheme: string;
  palette?: string;
  /** Values at the ends of the palette, for numeric schemes. */
  range?: [number, number];
  legend: { label: string; color: string }[];
}

export interface AtomColors {
  /** Red, green, blue (sRGB) and alpha of each atom of the file. */
  rgba: Uint8Array;
  legend: Legend;
}

/** Schemes by properties of atoms, with their labels. */
export const SCHEMES: readonly (readonly [string, string])[] = [
  ["none", "one colour"],
  ["element", "by element"],
  ["chain", "by chain"],
  ["entity", "by entity"],
  ["residue", "by residue"],
  ["secondary-structure", "secondary structure"],
  ["bfactor", "B-factor"],
  ["occupancy", "occupancy"],
  ["plddt", "pLDDT"],
  ["hydrophobicity", "hydrophobicity"],
  ["hydrophobicity:wimley-white", "hydrophobicity (Wimley–White)"],
  ["charge", "charge"],
];

const LABELS = new Map<string, string>([
  ...SCHEMES,
  ["uniform:", "another colour"],
  ["curvature", "curvature"],
  ["radial", "distance from the centre"],
  ["depth", "depth below the convex hull"],
  ["pocket", "pockets"],
]);

/** Returns the label of a scheme; its name if it has none. */
export const labelOf = (scheme: string): string => LABELS.get(scheme) ?? scheme;

/** Parameters of a mesh that affect the colours of its atoms. */
const SHARED = ["palette", "color_range", "model", "chains", "select", "altloc", "assembly", "context"];

/** Returns the path of the colours of a structure; null without a colour scheme. */
export function colorsPath(structure: string, choices: Choices): string | null {
  const scheme = choices.get("color") ?? "none";
  if (scheme === "none") return null;
  const shared = [...choices].filter(([name]) => SHARED.includes(name));
  return `${structure}/colors${query(new Map([["scheme", scheme], ...shared]))}`;
}

export async function atomColors(client: Client, path: string, signal: AbortSignal): Promise<AtomColors> {
  const reply = await client.ask(path, { signal });
  const rgba = new Uint8Array(await reply.arrayBuffer());
  return { rgba, legend: JSON.parse(reply.headers.get("molmesh-colors") ?? "{}") as Legend };
}
