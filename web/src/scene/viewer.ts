/** Viewer of a surface on a canvas. Draws only when something has changed. */

import { type BufferGeometry, Color, DataTexture, Mesh, PerspectiveCamera, Raycaster, Scene, SRGBColorSpace, Vector2, type Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { ViewerOptions } from "./context";
import { type Loaded, unitScale } from "./load";
import { depthLayer, depthsOnly, SurfaceMaterial } from "./material";
import { type Hit, pick, placeOf } from "./pick";
import { FRONT, moved, place, type View, viewOf } from "./view";

/** Duration of the initial rotation, s: one full turn. */
const TURN = 14;
/** Maximum device pixels per CSS pixel. More is not visible. */
const MAX_PIXEL_RATIO = 2;
/** Frame time, ms, above which the resolution is reduced during motion. */
const SLOW = 40;

export class Viewer {
  readonly controls: OrbitControls;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(28, 1, 0.1, 1000);
  /** One mesh per part. They share a material. */
  private meshes: Mesh[] = [];
  private material: SurfaceMaterial | null = null;
  /** Material that writes only depths. */
  private depths: SurfaceMaterial | null = null;
  private sticks: { mesh: Mesh; material: SurfaceMaterial } | null = null;
  private transparency = 0;
  /** Names of hidden parts. */
  private readonly hidden = new Set<string>();
  private loaded: Loaded | null = null;
  private colors: { texture: DataTexture; atoms: number } | null = null;
  /** True if the colours of the file are shown without colours per atom. */
  private usesFile = true;
  private haze = new Color("#ffffff");
  private plain = new Color("#5fb3a1");
  private marked = { hovered: [-2, -2], pinned: [-2, -2] };
  private frame = 0;
  private lastFrame = 0;
  private slowness = 0;
  /** Remaining time of the rotation, s. */
  private turnLeft = 0;
  private settle = 0;
  private readonly size = new ResizeObserver(() => this.resize());
  private readonly reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

  /** Creates a viewer on `canvas` with the context `gl`. */
  constructor(readonly canvas: HTMLCanvasElement, gl: WebGL2RenderingContext, private readonly options: ViewerOptions = {}) {
    this.renderer = new WebGLRenderer({ canvas, context: gl, antialias: true, alpha: options.transparent ?? false });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.invalidate());
    this.controls.addEventListener("start", () => this.turn(false));
    canvas.addEventListener("webglcontextlost", () => options.onLost?.(true));
    canvas.addEventListener("webglcontextrestored", () => {
      options.onLost?.(false);
      // The restored context lacks the clear colour. three.js restores everything else.
      this.clear();
      this.invalidate();
    });
    this.size.observe(canvas);
    this.resize();
  }

  /** Shows a surface. Resets the view if `fresh`. Resolves in the frame after the one that shows it. */
  show(loaded: Loaded, fresh: boolean): Promise<number> {
    const isFirst = !this.loaded;
    this.scene.remove(...this.meshes);
    this.release();
    const [{ geometry: first }] = loaded.parts as [Loaded["parts"][0]];
    const material = (this.material = new SurfaceMaterial(first, loaded.twoSided));
    this.depths = depthsOnly(first, loaded.twoSided);
    this.meshes = loaded.parts.map(({ name, geometry, matrix }) => {
      const mesh = new Mesh(geometry, material);
      mesh.matrixAutoUpdate = false;
      mesh.matrix.copy(matrix);
      mesh.frustumCulled = false;
      mesh.renderOrder = 1;
      mesh.visible = !this.hidden.has(name);
      return mesh;
    });
    this.loaded = loaded;
    this.scene.add(...this.meshes);
    this.applyStyle();
    this.applyTransparency();
    if (fresh || isFirst) this.reset();
    else this.clip();
    return this.drawn();
  }

  /** Returns the names of the visible parts. */
  get shownParts(): string[] {
    return this.partNames.filter((name) => !this.hidden.has(name));
  }

  /** Returns the names of the hidden parts. */
  get hiddenParts(): string[] {
    return this.partNames.filter((name) => this.hidden.has(name));
  }

  /** Returns the names of the parts. Instances of a part share its name. */
  get partNames(): string[] {
    return [...new Set((this.loaded?.parts ?? []).map(({ name }) => name))];
  }

  /** Shows or hides the parts with this name. */
  showPart(name: string, visible: boolean): void {
    const others = [...this.hidden].filter((other) => other !== name);
    this.hideParts(visible ? others : [...others, name]);
  }

  /** Hides the parts with these names and shows all others, also in the following surfaces. */
  hideParts(names: Iterable<string>): void {
    this.hidden.clear();
    for (const name of names) this.hidden.add(name);
    this.meshes.forEach((mesh, i) => (mesh.visible = !this.hidden.has(this.loaded?.parts[i]?.name ?? "")));
    this.invalidate();
  }

  private release(): void {
    for (const { geometry } of this.meshes) geometry.dispose();
    this.material?.dispose();
    this.depths?.dispose();
  }

  /** Sets the transparency of the surface: 0 is opaque, 1 is invisible. */
  setTransparency(transparency: number): void {
    this.transparency = transparency;
    this.applyTransparency();
    this.invalidate();
  }

  /** Draws the depths of a transparent surface first, so that only its nearest layer is visible. */
  private applyTransparency(): void {
    const { material, depths } = this;
    if (!material || !depths) return;
    const isTransparent = this.transparency > 0;
    material.set("alpha", 1 - this.transparency);
    if (material.transparent === isTransparent && !isTransparent) return;
    material.transparent = isTransparent;
    material.needsUpdate = true;
    for (const mesh of this.meshes) {
      mesh.clear();
      if (isTransparent) mesh.add(depthLayer(mesh, depths));
    }
  }

  /** Shows sticks with coordinates in Å, which stay when another surface is shown; null for none. */
  showSticks(geometry: BufferGeometry | null): void {
    if (!geometry && !this.sticks) return;
    if (this.sticks) {
      this.scene.remove(this.sticks.mesh);
      this.sticks.mesh.geometry.dispose();
      this.sticks.material.dispose();
      this.sticks = null;
    }
    if (geometry) {
      const material = new SurfaceMaterial(geometry);
      const mesh = new Mesh(geometry, material);
      mesh.frustumCulled = false;
      this.sticks = { mesh, material };
      this.scene.add(mesh);
    }
    this.applyStyle();
    this.invalidate();
  }

  /** Resolves with the time in the frame after the next one that is drawn. */
  drawn(): Promise<number> {
    this.invalidate();
    return new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(() => resolve(performance.now()))));
  }

  /** Resets the view to the whole surface from the front. */
  reset(): void {
    this.view = FRONT;
  }

  /** View of the surface; the initial one without a surface. */
  get view(): View {
    return this.loaded ? viewOf(this.camera, this.controls.target, this.loaded.sphere) : FRONT;
  }

  set view(view: View) {
    if (!this.loaded) return;
    place(this.camera, this.controls.target, this.loaded.sphere, view);
    this.clip();
    this.controls.update();
    this.invalidate();
  }

  /** Starts or stops the rotation. Unless `byUser`, it turns once, or not at all if reduced motion is preferred. */
  turn(on: boolean, byUser = false): void {
    const was = this.controls.autoRotate;
    this.turnLeft = !on || (this.reducedMotion.matches && !byUser) ? 0 : byUser ? Number.POSITIVE_INFINITY : TURN;
    this.controls.autoRotate = this.isTurning;
    this.controls.autoRotateSpeed = 60 / TURN;
    if (was !== this.isTurning) this.options.onTurn?.(this.isTurning);
    this.invalidate();
  }

  get isTurning(): boolean {
    return this.turnLeft > 0;
  }

  /** Turns by angles (radians) and zooms by a factor. Used by the keyboard. */
  move(right: number, down: number, nearer = 1): void {
    this.turn(false);
    this.view = moved(this.view, right, down, nearer);
  }

  /** Returns the atom under a point of the canvas, with (0, 0) in the middle and (1, 1) in the upper right corner. */
  pick(x: number, y: number): Hit | null {
    const { loaded } = this;
    if (!loaded) return null;
    const caster = new Raycaster();
    this.camera.updateMatrixWorld();
    caster.setFromCamera(new Vector2(x, y), this.camera);
    const { ray } = caster;
    const shown = loaded.parts.filter((_, i) => this.meshes[i]?.visible);
    const hits = shown.map(({ geometry, matrix }) => pick(geometry, matrix, ray, loaded.twoSided));
    const distance = ({ point }: Hit) => point.distanceToSquared(ray.origin);
    return hits.reduce((best, hit) => (hit && (!best || distance(hit) < distance(best)) ? hit : best), null);
  }

  /** Turns the surface of the atoms `first` to `last` to the camera. Returns false if they have none. */
  face(first: number, last: number): boolean {
    if (!this.loaded) return false;
    const places = this.loaded.parts.map(({ geometry, matrix }) => placeOf(geometry, matrix, first, last));
    const place = places.find((found) => found !== null);
    if (!place) return false;
    this.turn(false);
    const distance = this.camera.position.distanceTo(this.controls.target);
    const direction = place.sub(this.loaded.sphere.center).normalize();
    this.camera.position.copy(this.controls.target).addScaledVector(direction, distance);
    this.controls.update();
    this.invalidate();
    return true;
  }

  /** Projects a point of the scene to the canvas, in the coordinates of `pick`. */
  project(place: Vector3): { x: number; y: number } {
    this.camera.updateMatrixWorld();
    const { x, y } = place.clone().project(this.camera);
    return { x, y };
  }

  /** Marks atoms by first and last row, inclusive; null marks none. */
  mark(which: "hovered" | "pinned", rows: [number, number] | null): void {
    const next = rows ?? [-2, -2];
    if (this.marked[which].every((row, i) => row === next[i])) return;
    this.marked[which] = next;
    this.applyStyle();
    this.invalidate();
  }

  /** Sets the colours per atom; null for the colours of the file if `usesFile`, otherwise for one colour. */
  colour(texture: DataTexture | null, atoms: number, usesFile: boolean): void {
    this.usesFile = usesFile;
    this.colors?.texture.dispose();
    this.colors = texture ? { texture, atoms } : null;
    if (texture) this.renderer.initTexture(texture);
    this.applyStyle();
    this.invalidate();
  }

  /** Sets the background, and the colour of a surface without atom colours. */
  theme(background: string, plain: string): void {
    this.haze = new Color(background);
    this.plain = new Color(plain);
    this.clear();
    this.applyStyle();
    this.invalidate();
  }

  private clear(): void {
    if (!this.options.transparent) this.renderer.setClearColor(this.haze, 1);
  }

  /** Returns the number of triangles of all parts. */
  get triangles(): number {
    return (this.loaded?.parts ?? []).reduce((sum, { geometry }) => sum + (geometry.getIndex()?.count ?? 0) / 3, 0);
  }

  /** Waits until drawing has finished, since the GPU works asynchronously. For measurements. */
  finish(): void {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.size.disconnect();
    this.controls.dispose();
    this.release();
    this.showSticks(null);
    this.colors?.texture.dispose();
    this.renderer.dispose();
  }

  /** Draws in the next frame. */
  invalidate(): void {
    if (!this.frame) this.frame = requestAnimationFrame((now) => this.draw(now));
  }

  private draw(now: number): void {
    this.frame = 0;
    const turning = this.isTurning;
    if (this.controls.autoRotate && !turning) this.turn(false);
    const step = now - this.lastFrame;
    this.lastFrame = now;
    if (step < 500) this.slowness += 0.3 * (step - this.slowness);
    if (turning) {
      const time = Math.min(step / 1000, 0.1, this.turnLeft);
      this.turnLeft -= time;
      this.controls.update(time);
    }
    // Without a GPU, a lower resolution keeps motion smooth. The full resolution returns at rest.
    const moving = step < 250;
    this.sharpen(moving && this.slowness > SLOW ? Math.max(0.5, Math.sqrt(SLOW / this.slowness)) : 1);
    this.renderer.render(this.scene, this.camera);
    clearTimeout(this.settle);
    if (turning) this.invalidate();
    else if (this.coarse < 1) this.settle = window.setTimeout(() => this.rest(), 200);
  }

  private coarse = 1;

  private rest(): void {
    this.lastFrame = 0;
    this.slowness = 0;
    this.invalidate();
  }

  private sharpen(coarse: number): void {
    const next = Math.round(coarse * 4) / 4;
    if (next === this.coarse) return;
    this.coarse = next;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO) * next);
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO) * this.coarse);
    this.renderer.setSize(clientWidth, clientHeight, false);
    const before = Math.min(1, this.camera.aspect);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    // A narrower canvas still shows the whole surface.
    const nearer = before / Math.min(1, this.camera.aspect);
    if (nearer !== 1) this.camera.position.sub(this.controls.target).multiplyScalar(nearer).add(this.controls.target);
    this.clip();
    // A resized canvas is empty until it is drawn.
    cancelAnimationFrame(this.frame);
    this.frame = 0;
    this.renderer.render(this.scene, this.camera);
    this.invalidate();
  }

  /** Sets the near and far planes around the surface. */
  private clip(): void {
    if (!this.loaded) return;
    const { radius } = this.loaded.sphere;
    this.controls.minDistance = radius * 0.25;
    this.controls.maxDistance = radius * 14;
    this.camera.near = radius * 0.02;
    this.camera.far = radius * 18;
    this.camera.updateProjectionMatrix();
  }

  /** Applies colours and marks to the surface. */
  private applyStyle(): void {
    const { material, loaded, sticks } = this;
    if (!material || !loaded) return;
    const scale = unitScale(loaded);
    const materials = [material, ...(sticks ? [sticks.material] : [])];
    for (const each of materials) {
      each.set("haze", this.haze);
      each.set("unit", 1 / scale);
    }
    sticks?.mesh.scale.setScalar(1 / scale);
    material.set("plain", this.plain);
    material.set("own", this.usesFile);
    material.set("hovered", new Vector2(...this.marked.hovered));
    material.set("pinned", new Vector2(...this.marked.pinned));
    material.set("atoms", this.colors?.atoms ?? 0);
    if (this.colors) material.set("palette", this.colors.texture);
    const prepare = () => {
      const distance = this.camera.position.distanceTo(this.loaded?.sphere.center ?? this.controls.target);
      const radius = this.loaded?.sphere.radius ?? 1;
      for (const each of materials) {
        each.set("depths", new Vector2(distance - 0.5 * radius, distance + radius));
        each.uniformsNeedUpdate = true;
      }
    };
    for (const mesh of [...this.meshes, ...(sticks ? [sticks.mesh] : [])]) mesh.onBeforeRender = prepare;
  }
}
