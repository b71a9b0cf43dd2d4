/** Types of `<molmesh-viewer>`, in scripts and in TSX. */

import type { JobStatus } from "./api.js";
import type { ProblemDocument } from "./problem.js";

/** Attributes of the element. Attributes without a value may be true in TSX. */
export interface MolmeshViewerAttributes {
  /** Address of a GLB, or of the `tileset.json` of a tileset. */
  src?: string;
  /** Text for screen readers. */
  alt?: string;
  /** Colour of a surface without colours of its own. */
  color?: string;
  /** Colour scheme, a value of the parameter `color`. */
  scheme?: string;
  /** Shows a menu of the colour schemes. */
  menu?: boolean | "";
  /** Draws ligands, cofactors and glycans as sticks. */
  sticks?: boolean | "";
  /** Transparency of the surface in per cent, 0 to 90. */
  transparency?: number | string;
  /** Colour behind the surface. */
  background?: string;
  /** The surface makes one turn after loading. */
  turn?: boolean | "";
}

export interface MolmeshViewerEvents {
  /** A surface is shown. `report` is the `asset.extras` of its file. */
  "molmesh-load": CustomEvent<{ report: Record<string, unknown> }>;
  /** The surface was clicked: row of the atom in `…/atoms`, and the position in the units of the file. */
  "molmesh-pick": CustomEvent<{ atom: number | null; point: [number, number, number] | null }>;
  /** A frame shows tiles: numbers of visible tiles and triangles, finest and coarsest spacing in Å, loaded bytes. */
  "molmesh-tiles": CustomEvent<{ tiles: number; triangles: number; spacings: [number, number]; bytes: number; loading: boolean }>;
  /** The service makes the mesh in a job. */
  "molmesh-progress": CustomEvent<{ status: JobStatus; stage: string | null; fraction: number }>;
  /** The surface cannot be shown. `problem` is the error document, if the service sent one. */
  "molmesh-error": CustomEvent<{ message: string; problem: ProblemDocument | null }>;
  "molmesh-contextlost": CustomEvent<Record<string, never>>;
  "molmesh-contextrestored": CustomEvent<Record<string, never>>;
}

/** The element. Importing `@molmesh/client/viewer` defines it. */
export declare class MolmeshViewer extends HTMLElement {
  src: string;
  addEventListener<Name extends keyof MolmeshViewerEvents>(
    name: Name, listener: (event: MolmeshViewerEvents[Name]) => void, options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(name: string, listener: EventListenerOrEventListenerObject, options?: boolean | AddEventListenerOptions): void;
}

/** Attributes of the element in TSX, with those of every element. */
export interface MolmeshViewerProps extends MolmeshViewerAttributes {
  id?: string;
  class?: string;
  className?: string;
  slot?: string;
  style?: string | object;
  key?: string | number | null;
  ref?: unknown;
  children?: unknown;
  /** Event listeners, in the notation of the framework. */
  [listener: `on${string}`]: unknown;
}

declare global {
  interface HTMLElementTagNameMap {
    "molmesh-viewer": MolmeshViewer;
  }
  namespace JSX {
    interface IntrinsicElements {
      "molmesh-viewer": MolmeshViewerProps;
    }
  }
}
