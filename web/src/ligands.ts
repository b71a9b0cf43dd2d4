/** Ligands of a structure as sticks, for the page and the component. */

import type { BufferGeometry } from "three";
import { atomColors, colorsPath } from "./api/colors";
import type { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import { positions } from "./api/structures";
import { query } from "./request";
import { type Choices, SELECTION } from "./rules";
import { MAX_ATOMS, sticks } from "./scene/sticks";
import { number } from "./ui/dom";

export interface Ligands {
  /** Sticks; null if there are none to draw. */
  geometry: BufferGeometry | null;
  note: string;
}

/** Returns the parameters of the ligands of a mesh, with the copies of its assembly. Includes cofactors and glycans. */
function ligandSelection(choices: Choices): Choices {
  return new Map([["select", "ligand"], ...[...choices].filter(([name]) => SELECTION.includes(name))]);
}

export const ligandsPath = (structure: string, choices: Choices): string => structure + query(ligandSelection(choices));

/** Fetches the ligands of a structure and their colours. */
export async function fetchLigands(client: Client, structure: string, choices: Choices, signal: AbortSignal): Promise<Ligands> {
  const selection = ligandSelection(choices);
  const colors = colorsPath(structure, new Map([...selection, ["color", "element"]])) ?? "";
  try {
    const [atoms, { rgba }] = await Promise.all([positions(client, structure, selection, signal), atomColors(client, colors, signal)]);
    const { x, y, z, index, elements, residues } = atoms;
    if (x.length > MAX_ATOMS) return { geometry: null, note: `${number(x.length)} atoms of ligands; at most ${number(MAX_ATOMS)} can be drawn.` };
    const own = new Uint8Array(4 * index.length);
    index.forEach((row, i) => own.set(rgba.subarray(4 * row, 4 * row + 4), 4 * i));
    const started = performance.now();
    const { geometry, bonds } = sticks({ x, y, z, elements, rgba: own });
    // Read by the browser tests.
    performance.measure("molmesh:sticks", { start: started, detail: { sticks: x.length, bonds } });
    const names = [...new Set(residues)];
    return { geometry, note: `${number(x.length)} atoms: ${names.slice(0, 8).join(", ")}${names.length > 8 ? ", …" : ""}` };
  } catch (error) {
    if (error instanceof Problem && error.is("empty-selection")) return { geometry: null, note: "No ligands in the selected chains." };
    throw error;
  }
}
