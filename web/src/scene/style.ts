/** Colours and marked atoms of a surface, for its materials. */

import { Color, type DataTexture, Vector2 } from "three";
import type { SurfaceMaterial } from "./material";

/** First and last row of atoms, inclusive. */
export type Rows = [number, number];

/** Rows that no atom has. */
const NONE: Rows = [-2, -2];

export class Style {
  /** Colour of the background and of the fog. */
  haze = new Color("#ffffff");
  private plain = new Color("#5fb3a1");
  private readonly marked = { hovered: NONE, pinned: NONE };
  private colors: { texture: DataTexture; atoms: number } | null = null;
  /** True if the colours of the file are shown without colours per atom. */
  private usesFile = true;

  /** Marks atoms; null marks none. Returns false if they were marked before. */
  mark(which: "hovered" | "pinned", rows: Rows | null): boolean {
    const next = rows ?? NONE;
    if (this.marked[which].every((row, i) => row === next[i])) return false;
    this.marked[which] = next;
    return true;
  }

  /** Sets the colours per atom; null for the colours of the file if `usesFile`, otherwise for one colour. */
  colour(texture: DataTexture | null, atoms: number, usesFile: boolean): void {
    this.dispose();
    this.usesFile = usesFile;
    this.colors = texture ? { texture, atoms } : null;
  }

  /** Sets the background, and the colour of a surface without atom colours. */
  theme(background: string, plain: string): void {
    this.haze = new Color(background);
    this.plain = new Color(plain);
  }

  /** Applies the fog to a material whose scene has `scale` Å per unit. */
  applyFog(material: SurfaceMaterial, scale: number): void {
    material.set("haze", this.haze);
    material.set("unit", 1 / scale);
  }

  /** Applies colours and marks to the material of a surface. */
  apply(material: SurfaceMaterial): void {
    material.set("plain", this.plain);
    material.set("own", this.usesFile);
    material.set("hovered", new Vector2(...this.marked.hovered));
    material.set("pinned", new Vector2(...this.marked.pinned));
    material.set("atoms", this.colors?.atoms ?? 0);
    if (this.colors) material.set("palette", this.colors.texture);
  }

  dispose(): void {
    this.colors?.texture.dispose();
  }
}
