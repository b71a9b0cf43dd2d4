/** View of the camera: direction, magnification and centre, independent of the size of the canvas. */

import { MathUtils, type PerspectiveCamera, type Sphere, Vector3 } from "three";
import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

export interface CameraView {
  /** Direction from the centre of the view to the camera, degrees: about the y axis, from +z to +x. */
  azimuth: number;
  /** Angle of this direction above the plane of x and z, degrees. */
  elevation: number;
  /** Magnification; 1 shows the whole surface. */
  zoom: number;
  /** Centre of the view relative to that of the surface, in units of the file. */
  shift: [number, number, number];
}

/** Maximum elevation, degrees. At 90, the direction upwards would be undefined. */
const MAX_ELEVATION = 88.8;

/** Initial view: the whole surface from the front, slightly from the right and from above. */
export const FRONT: CameraView = {
  azimuth: MathUtils.radToDeg(Math.atan2(0.25, 1)),
  elevation: MathUtils.radToDeg(Math.atan2(0.2, Math.hypot(0.25, 1))),
  zoom: 1,
  shift: [0, 0, 0],
};

/** Distance from the camera to the centre of the view at a magnification of 1, in units of the file. */
function distance(camera: PerspectiveCamera, { radius }: Sphere): number {
  // A narrow canvas still shows the whole surface.
  return (0.8 * radius) / Math.sin(MathUtils.degToRad(camera.fov) / 2) / Math.min(1, camera.aspect);
}

/** Moves the camera and the centre of its view, `target`. */
export function place(camera: PerspectiveCamera, target: Vector3, sphere: Sphere, view: CameraView): void {
  const elevation = MathUtils.clamp(view.elevation, -MAX_ELEVATION, MAX_ELEVATION);
  const [phi, theta] = [90 - elevation, view.azimuth].map(MathUtils.degToRad) as [number, number];
  target.fromArray(view.shift).add(sphere.center);
  camera.up.set(0, 1, 0);
  camera.position.setFromSphericalCoords(distance(camera, sphere) / view.zoom, phi, theta).add(target);
}

/** Returns the view of the camera. */
export function viewOf(camera: PerspectiveCamera, target: Vector3, sphere: Sphere): CameraView {
  const offset = camera.position.clone().sub(target);
  const azimuth = MathUtils.radToDeg(Math.atan2(offset.x, offset.z));
  const elevation = MathUtils.radToDeg(Math.atan2(offset.y, Math.hypot(offset.x, offset.z)));
  const shift = target.clone().sub(sphere.center).toArray();
  return { azimuth, elevation, zoom: distance(camera, sphere) / offset.length(), shift };
}

/** Returns a view that is turned by angles, radians, and magnified by a factor. */
export function moved({ azimuth, elevation, zoom, shift }: CameraView, right: number, down: number, nearer: number): CameraView {
  const degrees = MathUtils.radToDeg;
  return { azimuth: azimuth - degrees(right), elevation: elevation + degrees(down), zoom: zoom * nearer, shift };
}

/** Returns azimuth, elevation and magnification, and the centre if it is shifted, separated by commas. */
function numbersOf(view: CameraView): string {
  // Fewer digits would move edges by a visible fraction of a pixel.
  const text = (value: number) => String(Number(value.toFixed(4)) || 0);
  const [numbers, shift] = [[view.azimuth, view.elevation, view.zoom].map(text), view.shift.map(text)];
  return (shift.some((value) => value !== "0") ? [...numbers, ...shift] : numbers).join(",");
}

/** Returns a view as text; empty for `FRONT`. */
export function cameraText(view: CameraView): string {
  const text = numbersOf(view);
  return text === numbersOf(FRONT) ? "" : text;
}

/** Returns the view that `cameraText` wrote; `FRONT` if the text is no view. */
export function parseCamera(text: string): CameraView {
  const words = text.split(",");
  const numbers = words.map((word) => (word.trim() === "" ? Number.NaN : Number(word)));
  const isView = [3, 6].includes(words.length) && numbers.every(Number.isFinite);
  const [azimuth, elevation, zoom, ...shift] = numbers as [number, number, number, ...number[]];
  if (!isView || zoom <= 0) return FRONT;
  const [x = 0, y = 0, z = 0] = shift;
  return { azimuth, elevation, zoom, shift: [x, y, z] };
}

/**
 * Sets the limits of distances for a surface of this radius. With `details` (tiles), the camera can come closer and
 * zooms to the pointer.
 */
export function bound(camera: PerspectiveCamera, controls: OrbitControls, radius: number, details: boolean): void {
  const nearest = radius * (details ? 0.02 : 0.25);
  controls.zoomToCursor = details;
  controls.minDistance = nearest;
  controls.maxDistance = radius * 14;
  camera.near = nearest * 0.08;
  camera.far = radius * 18;
  camera.updateProjectionMatrix();
}
