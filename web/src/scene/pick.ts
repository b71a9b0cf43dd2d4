/** Search for the atom under a ray, directly in the buffers of the file. */

import { InterleavedBufferAttribute, Matrix4, Ray, Vector3, type BufferAttribute, type BufferGeometry } from "three";

interface Column {
  array: ArrayLike<number>;
  stride: number;
  offset: number;
}

function column(geometry: BufferGeometry, name: string): Column | null {
  if (!geometry.hasAttribute(name)) return null;
  const attribute = geometry.getAttribute(name) as BufferAttribute | InterleavedBufferAttribute;
  if (attribute instanceof InterleavedBufferAttribute) return { array: attribute.data.array, stride: attribute.data.stride, offset: attribute.offset };
  return { array: attribute.array, stride: attribute.itemSize, offset: 0 };
}

export interface Hit {
  /** Row of the atom; −1 if the mesh has no atom ids. */
  atom: number;
  /** Position in file units. */
  point: Vector3;
}

/**
 * Finds the first triangle that faces the origin of `ray`, and the atom of its corner nearest to the intersection.
 * `ray` is in scene coordinates; `matrix` transforms the mesh into them. With `twoSided`, triangles may face away.
 */
export function pick(geometry: BufferGeometry, matrix: Matrix4, ray: Ray, twoSided: boolean): Hit | null {
  const positions = column(geometry, "position");
  const index = geometry.getIndex()?.array;
  if (!positions || !index) return null;
  const { origin, direction } = ray.clone().applyMatrix4(matrix.clone().invert());
  const [ox, oy, oz] = origin.toArray();
  const [dx, dy, dz] = direction.toArray();
  const { array, stride, offset } = positions;
  let [nearest, at, bu, bv] = [Infinity, -1, 0, 0];
  for (let t = 0; t < index.length; t += 3) {
    const a = index[t]! * stride + offset;
    const b = index[t + 1]! * stride + offset;
    const c = index[t + 2]! * stride + offset;
    const ax = array[a]!, ay = array[a + 1]!, az = array[a + 2]!;
    const ex = array[b]! - ax, ey = array[b + 1]! - ay, ez = array[b + 2]! - az;
    const fx = array[c]! - ax, fy = array[c + 1]! - ay, fz = array[c + 2]! - az;
    // Möller–Trumbore. Back faces have a determinant that is not positive.
    const px = dy * fz - dz * fy, py = dz * fx - dx * fz, pz = dx * fy - dy * fx;
    const signed = ex * px + ey * py + ez * pz;
    if (twoSided ? signed === 0 : signed <= 0) continue;
    const [det, side] = [Math.abs(signed), Math.sign(signed)];
    const sx = side * (ox - ax), sy = side * (oy - ay), sz = side * (oz - az);
    const u = sx * px + sy * py + sz * pz;
    if (u < 0 || u > det) continue;
    const qx = sy * ez - sz * ey, qy = sz * ex - sx * ez, qz = sx * ey - sy * ex;
    const v = dx * qx + dy * qy + dz * qz;
    if (v < 0 || u + v > det) continue;
    const distance = (fx * qx + fy * qy + fz * qz) / det;
    if (distance > 0 && distance < nearest) [nearest, at, bu, bv] = [distance, t, u / det, v / det];
  }
  if (at < 0) return null;
  const corner = 1 - bu - bv >= Math.max(bu, bv) ? 0 : bu >= bv ? 1 : 2;
  const atoms = column(geometry, "_atom");
  const vertex = index[at + corner]!;
  const atom = atoms ? Math.round(atoms.array[vertex * atoms.stride + atoms.offset]!) : -1;
  const point = new Vector3(dx, dy, dz).multiplyScalar(nearest).add(origin).applyMatrix4(matrix);
  return { atom, point };
}

/** Returns the vertex of the atoms `first` to `last` that is nearest to their centre; null if they have none. */
export function placeOf(geometry: BufferGeometry, matrix: Matrix4, first: number, last: number): Vector3 | null {
  const [positions, atoms] = [column(geometry, "position"), column(geometry, "_atom")];
  if (!positions || !atoms) return null;
  const count = geometry.getAttribute("position").count;
  const at = (i: number) => new Vector3().fromArray(positions.array, i * positions.stride + positions.offset);
  const theirs: number[] = [];
  const middle = new Vector3();
  for (let i = 0; i < count; i += 1) {
    const row = atoms.array[i * atoms.stride + atoms.offset]!;
    if (row < first || row > last) continue;
    theirs.push(i);
    middle.add(at(i));
  }
  if (!theirs.length) return null;
  middle.divideScalar(theirs.length);
  const nearest = theirs.reduce((best, i) => (at(i).distanceToSquared(middle) < at(best).distanceToSquared(middle) ? i : best));
  return at(nearest).applyMatrix4(matrix);
}
