/** Sticks of ligands: bonds as cylinders and atoms as balls, in one geometry with colours. */

import {
  BufferAttribute, BufferGeometry, Color, CylinderGeometry, Quaternion, SphereGeometry, SRGBColorSpace, Vector3,
} from "three";

/** Atoms with coordinates in Å. */
export interface StickAtoms {
  x: number[];
  y: number[];
  z: number[];
  elements: string[];
  /** Red, green, blue (sRGB) and alpha of each atom. */
  rgba: Uint8Array;
}

/** Maximum number of atoms. More take seconds to draw without a GPU. */
export const MAX_ATOMS = 20_000;

/** Radius of bonds and of bonded atoms, Å. */
const STICK = 0.2;
/** Radius of atoms without bonds, Å. */
const BALL = 0.45;
/** Two atoms are bonded up to this distance beyond the sum of their covalent radii, Å. */
const TOLERANCE = 0.45;
/** Distance up to which two atoms are copies of one, Å. */
const SAME = 0.4;

/** Covalent radii in pm by atomic number, from hydrogen to curium: Cordero et al. 2008, low spin for Mn, Fe and Co. */
const RADII = [
  31, 28, 128, 96, 84, 76, 71, 66, 57, 58, 166, 141, 121, 111, 107, 105, 102, 106, 203, 176, 170, 160, 153, 139, 139,
  132, 126, 124, 132, 122, 122, 120, 119, 120, 120, 116, 220, 195, 190, 175, 164, 154, 147, 146, 142, 139, 145, 144,
  142, 139, 139, 138, 139, 140, 244, 215, 207, 204, 203, 201, 199, 198, 198, 196, 194, 192, 192, 189, 190, 187, 187,
  175, 170, 162, 151, 144, 141, 136, 136, 132, 145, 146, 148, 140, 150, 150, 260, 221, 215, 206, 200, 196, 190, 187,
  180, 169,
];
const SYMBOLS =
  "H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb Mo " +
  "Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl " +
  "Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm";
const RADIUS = new Map(SYMBOLS.split(" ").map((symbol, i) => [symbol.toUpperCase(), RADII[i]! / 100]));

/** Returns the covalent radius of an element in Å; that of carbon if the element is unknown. */
function radiusOf(element: string): number {
  const symbol = element.toUpperCase();
  return RADIUS.get(symbol === "D" ? "H" : symbol) ?? 0.76;
}

/** Returns the pairs of bonded atoms: those closer than the sum of their covalent radii and a tolerance. */
function bonds({ x, y, z, elements }: StickAtoms): [number, number][] {
  const radii = elements.map(radiusOf);
  const cell = 2 * radii.reduce((a, b) => Math.max(a, b), 0) + TOLERANCE;
  const cells = new Map<string, number[]>();
  const found: [number, number][] = [];
  for (let i = 0; i < x.length; i += 1) {
    const at = [x[i]!, y[i]!, z[i]!].map((value) => Math.floor(value / cell)) as [number, number, number];
    for (let n = 0; n < 27; n += 1) {
      const key = `${at[0] + (n % 3) - 1} ${at[1] + (Math.floor(n / 3) % 3) - 1} ${at[2] + Math.floor(n / 9) - 1}`;
      for (const j of cells.get(key) ?? []) {
        const distance = Math.hypot(x[i]! - x[j]!, y[i]! - y[j]!, z[i]! - z[j]!);
        if (distance > SAME && distance < radii[i]! + radii[j]! + TOLERANCE) found.push([j, i]);
      }
    }
    const own = at.join(" ");
    const those = cells.get(own);
    if (those) those.push(i);
    else cells.set(own, [i]);
  }
  return found;
}

/** Returns the sticks of the atoms, in Å, and the number of bonds. Each half of a bond has the colour of its atom. */
export function sticks(atoms: StickAtoms): { geometry: BufferGeometry; bonds: number } {
  const { x, y, z, rgba } = atoms;
  const [ball, rod] = [new SphereGeometry(1, 10, 7), new CylinderGeometry(1, 1, 1, 10, 1, true)];
  const pairs = bonds(atoms);
  const isBonded = new Set(pairs.flat());
  const place = (i: number) => new Vector3(x[i], y[i], z[i]);
  const shapes: [BufferGeometry, number][] = [[ball, x.length], [rod, 2 * pairs.length]];
  const total = (count: (shape: BufferGeometry) => number) =>
    shapes.reduce((sum, [shape, n]) => sum + n * count(shape), 0);
  const n = total((shape) => shape.getAttribute("position").count);
  const [position, normal, color] = [new Float32Array(3 * n), new Float32Array(3 * n), new Float32Array(3 * n)];
  const index = new Uint32Array(total((shape) => shape.getIndex()!.count));
  let [vertex, corner] = [0, 0];
  const [v, hue] = [new Vector3(), new Color()];
  /** Adds a shape that is scaled, turned and moved, in the colour of an atom. */
  const add = (shape: BufferGeometry, atom: number, scale: Vector3, turn: Quaternion, centre: Vector3) => {
    const [points, normals] = [shape.getAttribute("position"), shape.getAttribute("normal")];
    const corners = shape.getIndex()!;
    const [r, g, b] = rgba.subarray(4 * atom, 4 * atom + 3);
    hue.setRGB(r! / 255, g! / 255, b! / 255, SRGBColorSpace);
    for (let k = 0; k < corners.count; k += 1) index[corner + k] = vertex + corners.getX(k);
    corner += corners.count;
    for (let k = 0; k < points.count; k += 1, vertex += 1) {
      v.fromBufferAttribute(points, k).multiply(scale).applyQuaternion(turn).add(centre).toArray(position, 3 * vertex);
      v.fromBufferAttribute(normals, k).applyQuaternion(turn).toArray(normal, 3 * vertex);
      hue.toArray(color, 3 * vertex);
    }
  };
  const still = new Quaternion();
  for (let i = 0; i < x.length; i += 1) {
    const radius = isBonded.has(i) ? STICK : BALL;
    add(ball, i, new Vector3(radius, radius, radius), still, place(i));
  }
  for (const pair of pairs) {
    const [a, b] = pair.map(place) as [Vector3, Vector3];
    const half = b.clone().sub(a).multiplyScalar(0.5);
    const scale = new Vector3(STICK, half.length(), STICK);
    const turn = new Quaternion().setFromUnitVectors(new Vector3(0, 1, 0), half.clone().normalize());
    add(rod, pair[0], scale, turn, a.clone().addScaledVector(half, 0.5));
    add(rod, pair[1], scale, turn, b.clone().addScaledVector(half, -0.5));
  }
  const geometry = new BufferGeometry();
  const columns = Object.entries({ position, normal, color });
  for (const [name, array] of columns) geometry.setAttribute(name, new BufferAttribute(array, 3));
  geometry.setIndex(new BufferAttribute(index, 1));
  for (const [shape] of shapes) shape.dispose();
  return { geometry, bonds: pairs.length };
}
