/** Structures: their paths, summaries and atom labels. */

import type { AtomsDocument, StructureDocument } from "../../client/dist/api";
import type { Client, Structure } from "../../client/src/client";
import { query } from "../request";
import type { Choices } from "../rules";

/** Source of a mesh: an upload, by the digest of its bytes, or an entry of the archive. */
export interface Source {
  /** Path before `/surface.glb`; empty before `find`. */
  path: string;
  /** Display name. */
  name: string;
  /** File name, for the command line. */
  file: string;
  /** The bytes, for another upload if the service has deleted them. */
  blob?: Blob;
  /** Uploads or finds the structure, and returns its complete source. Absent if this one is complete. */
  find?: (signal: AbortSignal) => Promise<Source>;
  /** True for the bundled structure, which the page opens by default. */
  isSample?: boolean;
  summary?: StructureDocument;
  /** Number of atoms in the file, once it is known. */
  atoms?: number;
}

/** Uploads a structure. Its path then gives access to meshes. */
export async function upload(client: Client, blob: Blob, file: string, signal?: AbortSignal): Promise<Source> {
  const summary = await client.upload(blob, { signal });
  return { path: `/v1/structures/${summary.digest}`, name: summary.id ?? file, file, blob, summary, atoms: summary.atoms };
}

/** Returns a structure that was uploaded before. */
export async function stored(client: Client, digest: string, signal: AbortSignal): Promise<Source> {
  const summary = await client.json<StructureDocument>(`/v1/structures/${encodeURIComponent(digest)}`, { signal });
  const name = summary.id ?? "structure";
  return { path: `/v1/structures/${summary.digest}`, name, file: `${name.toLowerCase()}.cif`, summary, atoms: summary.atoms };
}

/** Returns an entry of the archive. */
export function entry(id: string): Source {
  const name = id.trim();
  return { path: `/v1/pdb/${encodeURIComponent(name.toLowerCase())}`, name: name.toUpperCase(), file: "" };
}

/** Returns a source that `find` completes, at most once. */
export function pending(name: string, find: (signal: AbortSignal) => Promise<Source>): Source {
  let found: Source | undefined;
  return { path: "", name, file: "", find: async (signal) => (found ??= await find(signal)) };
}

/** Returns a structure as the client names it. */
export function named({ path }: Source): Structure {
  const name = decodeURIComponent(path.slice(path.lastIndexOf("/") + 1));
  return path.startsWith("/v1/pdb/") ? { pdb: name } : { digest: name };
}

export interface Atom {
  row: number;
  atom: string;
  element: string;
  residue: string;
  number: number;
  insertion: string;
  chain: string;
  kind: string;
  /** First and last row of its residue, inclusive. */
  first: number;
  last: number;
}

/** Labels of atoms by row. The mesh attribute `_ATOM` contains row numbers. */
export class Labels {
  constructor(private readonly document: AtomsDocument) {}

  /** Returns the atom in `row`. */
  of(row: number): Atom | null {
    const { atoms, names, elements, residues, count } = this.document;
    if (!(row >= 0 && row < count)) return null;
    let [low, high] = [0, residues.first.length];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if ((residues.first[middle] ?? 0) <= row) low = middle;
      else high = middle;
    }
    return {
      row,
      atom: names[atoms.name[row] ?? -1] ?? "?",
      element: elements[atoms.element[row] ?? -1] ?? "?",
      residue: residues.name[low] ?? "?",
      number: residues.number[low] ?? 0,
      insertion: residues.insertion_code[low] ?? "",
      chain: residues.chain[low] ?? "",
      kind: residues.kind[low] ?? "",
      first: residues.first[low] ?? 0,
      last: (residues.first[low + 1] ?? count) - 1,
    };
  }

  /** Finds an atom, preferably the alpha carbon, of the residue in `text`: `15`, `LYS 15`, `A:15`, `A LYS 15`. */
  find(text: string): Atom | null {
    const words = text.trim().toUpperCase().split(/[\s:/.,]+/).filter(Boolean);
    const { residues, names, atoms } = this.document;
    const fits = (i: number) => {
      const own = [`${residues.number[i]}${residues.insertion_code[i]}`, residues.name[i], residues.chain[i]].map((s) => String(s).toUpperCase());
      return words.every((word) => own.includes(word) || own[1] + own[0]! === word);
    };
    const at = words.length ? residues.first.findIndex((_, i) => fits(i)) : -1;
    if (at < 0) return null;
    const [first, end] = [residues.first[at] ?? 0, residues.first[at + 1] ?? this.document.count];
    for (let row = first; row < end; row += 1) if (["CA", "P", "C1'"].includes(names[atoms.name[row] ?? -1] ?? "")) return this.of(row);
    return this.of(first);
  }
}

/** Fetches the labels of a structure's atoms. */
export async function labels(client: Client, source: Source, signal: AbortSignal): Promise<Labels> {
  return new Labels(await client.json<AtomsDocument>(`${source.path}/atoms`, { signal }));
}

/** Atoms with coordinates in Å. */
export interface Positions {
  x: number[];
  y: number[];
  z: number[];
  /** Rows of the atoms in the whole list. */
  index: number[];
  elements: string[];
  /** Names of the residues. */
  residues: string[];
}

/** Fetches the atoms of a structure, by its path, that `selection` names, with the copies of an assembly. */
export async function positions(client: Client, structure: string, selection: Choices, signal: AbortSignal): Promise<Positions> {
  const path = `${structure}/atoms${query(selection, { positions: "true" })}`;
  const { atoms, elements, residues } = await client.json<AtomsDocument>(path, { signal });
  const { x, y, z, index } = atoms;
  return { x: x ?? [], y: y ?? [], z: z ?? [], index: index ?? [], elements: atoms.element.map((i) => elements[i] ?? "?"), residues: residues.name };
}

/** Returns the name of an atom, such as `LYS 15 A · CA`. */
export function nameOf(atom: Atom): string {
  return `${atom.residue} ${atom.number}${atom.insertion} ${atom.chain || "(blank)"} · ${atom.atom}`;
}
