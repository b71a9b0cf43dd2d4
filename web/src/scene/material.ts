/** Material of the surface: hemisphere light, two camera lights, darker hollows and edges, and distance fog. */

import {
  Color, DataTexture, DoubleSide, FrontSide, GLSL3, Mesh, NearestFilter, RGBAFormat, ShaderMaterial, SRGBColorSpace, UnsignedByteType, Vector2,
  type BufferGeometry,
} from "three";

/** Atoms per row of the palette, a texture width that every device supports. */
const PALETTE_WIDTH = 1024;

const VERTEX = /* glsl */ `
out vec3 vNormal;
out vec3 vEye;
out vec3 vColor;
out float vGlow;
uniform vec3 plain;
uniform bool own;
uniform vec2 hovered;
uniform vec2 pinned;
uniform int atoms;
uniform highp sampler2D palette;
#ifdef ATOMS
in float _atom;
#endif
float within(float row, vec2 range) { return step(range.x - 0.5, row) * step(row, range.y + 0.5); }
void main() {
  vec4 eye = modelViewMatrix * vec4(position, 1.0);
  vEye = eye.xyz;
  vColor = plain;
  // Vertex colours of the file.
  #if defined(USE_COLOR_ALPHA) || defined(USE_COLOR)
  if (own) vColor = color.rgb;
  #endif
  vGlow = 0.0;
  #ifdef NORMALS
  vNormal = normalMatrix * normal;
  #endif
  #ifdef ATOMS
  int row = int(_atom + 0.5);
  if (row < atoms) vColor = texelFetch(palette, ivec2(row % ${PALETTE_WIDTH}, row / ${PALETTE_WIDTH}), 0).rgb;
  vGlow = max(within(_atom, pinned), 0.6 * within(_atom, hovered));
  #endif
  gl_Position = projectionMatrix * eye;
}`;

const FRAGMENT = /* glsl */ `
in vec3 vNormal;
in vec3 vEye;
in vec3 vColor;
in float vGlow;
out vec4 color;
uniform vec3 haze;
uniform vec3 glow;
uniform vec2 depths;
uniform float hazy;
uniform float unit;
uniform float alpha;
const vec3 KEY = vec3(0.38, 0.62, 0.69);
const vec3 FILL = vec3(-0.75, -0.1, 0.65);
void main() {
  #ifdef NORMALS
  // Triangles that are seen from inside are lit as their visible side is.
  vec3 n = (gl_FrontFacing ? 1.0 : -1.0) * normalize(vNormal);
  #else
  vec3 n = normalize(cross(dFdx(vEye), dFdy(vEye)));
  #endif
  vec3 eye = normalize(-vEye);
  vec3 base = mix(vColor, glow, 0.72 * vGlow);
  float sky = 0.5 + 0.5 * n.y;
  vec3 light = mix(vec3(0.22, 0.21, 0.23), vec3(0.44, 0.46, 0.49), sky);
  light += vec3(0.62, 0.6, 0.56) * max(dot(n, KEY), 0.0);
  light += vec3(0.1, 0.11, 0.14) * max(dot(n, FILL), 0.0);
  #ifdef NORMALS
  // Change of the normal between pixels: hollows get less light, ridges slightly more.
  float bend = (dFdx(n).x + dFdy(n).y) / max(length(dFdx(vEye)) / unit, 1e-4);
  light *= 1.0 + clamp(bend * 0.16, -0.34, 0.1);
  #endif
  float facing = max(dot(n, eye), 0.0);
  light *= mix(0.62, 1.0, smoothstep(0.0, 0.45, facing));
  vec3 half_way = normalize(KEY + eye);
  float shine = 0.16 * pow(max(dot(n, half_way), 0.0), 36.0);
  vec3 lit = base * light + shine;
  float far = clamp((-vEye.z - depths.x) / (depths.y - depths.x), 0.0, 1.0);
  color = linearToOutputTexel(vec4(mix(lit, haze, hazy * far * far), alpha));
}`;

export class SurfaceMaterial extends ShaderMaterial {
  /** `twoSided`: both sides of the triangles are drawn, otherwise the outer one. */
  constructor(geometry: BufferGeometry, twoSided = false) {
    const defines: Record<string, string> = {};
    if (geometry.hasAttribute("normal")) defines["NORMALS"] = "1";
    if (geometry.hasAttribute("_atom")) defines["ATOMS"] = "1";
    super({
      glslVersion: GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      defines,
      side: twoSided ? DoubleSide : FrontSide,
      vertexColors: geometry.hasAttribute("color"),
      uniforms: {
        plain: { value: new Color("#5fb3a1") },
        glow: { value: new Color("#ffb020") },
        haze: { value: new Color("#ffffff") },
        hazy: { value: 0.55 },
        // True if the colours of the file are shown.
        own: { value: true },
        alpha: { value: 1 },
        depths: { value: new Vector2(0, 1) },
        // Units of the scene per ångström.
        unit: { value: 1 },
        hovered: { value: new Vector2(-2, -2) },
        pinned: { value: new Vector2(-2, -2) },
        atoms: { value: 0 },
        palette: { value: EMPTY },
      },
    });
  }

  set<T>(name: string, value: T): void {
    const uniform = this.uniforms[name];
    if (uniform) uniform.value = value;
  }
}

/** Returns a material that writes depths and no colours. It is drawn after opaque objects. */
export function depthsOnly(geometry: BufferGeometry, twoSided: boolean): SurfaceMaterial {
  const material = new SurfaceMaterial(geometry, twoSided);
  material.colorWrite = false;
  material.transparent = true;
  return material;
}

/** Returns a child of `mesh` that draws its depths. */
export function depthLayer(mesh: Mesh, depths: SurfaceMaterial): Mesh {
  const layer = new Mesh(mesh.geometry, depths);
  layer.matrixAutoUpdate = false;
  layer.frustumCulled = false;
  return layer;
}

/** Returns a texture with one colour per atom, for the vertex shader. `rgba` has four sRGB bytes per atom. */
export function palette(rgba: Uint8Array): DataTexture {
  const height = Math.max(1, Math.ceil(rgba.length / 4 / PALETTE_WIDTH));
  const data = new Uint8Array(PALETTE_WIDTH * height * 4);
  data.set(rgba);
  const texture = new DataTexture(data, PALETTE_WIDTH, height, RGBAFormat, UnsignedByteType);
  texture.colorSpace = SRGBColorSpace;
  texture.minFilter = texture.magFilter = NearestFilter;
  texture.needsUpdate = true;
  return texture;
}

const EMPTY = palette(new Uint8Array(4).fill(255));
