/** The 3D view of a robot. Loaded on demand; draws only after changes. */
import type { Targets } from "../steering/model";
import {
  type BufferGeometry, Color, DirectionalLight, GridHelper, HemisphereLight, type Material, type Mesh, MeshBasicMaterial, MeshLambertMaterial,
  MeshStandardMaterial, PerspectiveCamera, Scene, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { radians } from "../../shared/lib/angles";
import { isVisibleChange } from "./model/visible-change";
import { add, forward, rotate } from "./model/forward-kinematics";
import { now } from "../../shared/lib/clock";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import type { Geometry } from "../../shared/mqtt/protocol.generated";
import type { Vector3 as Vector } from "../../shared/lib/vectors";
import { DrawSlot } from "../../shared/hooks/draw-scheduler";
import { RobotMeshes } from "./robot-meshes";

export class NoWebglError extends Error {
  override name = "NoWebglError";
}

export interface LiveScene {
  /**
   * Shows the measured pose, and the target's if it differs (`null`: none). `moving`: the view follows a pointer. Then it is drawn in each
   * frame, and on a slow machine at a lower quality until it rests.
   */
  show(measured: Targets, target: Targets | null, moving?: boolean): void;
  /** Applies changed theme colours. */
  recolour(): void;
  resetView(): void;
  dispose(): void;
}

/** Closer to the measured pose than this, the target is not drawn [rad]. */
const GHOST_FROM = 0.005;
const GHOST_COLOUR = 0x2f8fe0;
const GHOST_OPACITY = 0.28;
/** A longer time between two frames of a moving view is slow; after this many, the machine has no graphics card [ms]. */
const SLOW_MS = 28;
const SLOW_FRAMES = 3;
/** Resolution of a quick frame, relative to that of the screen. */
const QUICK_RESOLUTION = 0.5;
/** A view that has not moved for this time is drawn at full quality [ms]. */
const REST_MS = 600;

/** Builds the view inside `canvas`. `onFrame` is called after every drawn frame. Throws `NoWebglError`. */
export function createScene(canvas: HTMLCanvasElement, twin: KnownTwin, onFrame: () => void): LiveScene {
  const renderer = createRenderer(canvas);
  const scene = new Scene();
  const robots = createRobots(scene, twin);
  const home = frame(twin);
  light(scene, home.radius);
  let grid = floor(scene, home);
  const camera = new PerspectiveCamera(38, 1, 0.01, 100);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, canvas);
  controls.enableDamping = false;

  let requested: Poses = { measured: {}, target: null };
  let drawn: Poses | null = null;
  let visible = true;
  const quality = new Quality(renderer, robots.materials);
  const slot = new DrawSlot(() => {
    quality.apply(canvas);
    robots.pose(requested);
    renderer.render(scene, camera);
    drawn = requested;
    onFrame();
  });
  // A view outside the viewport does not draw, except its first frame, so that scrolling never shows an empty view.
  const requestDraw = (): void => {
    if (visible || drawn === null) slot.request(quality.moving);
  };
  quality.onRest = requestDraw;
  const resetView = (): void => {
    controls.target.copy(home.centre);
    camera.position.copy(home.centre).add(new Vector3(1.15, -1.5, 0.75).normalize().multiplyScalar(home.radius * 3.2));
    controls.update();
    requestDraw();
  };
  const resize = (): void => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    quality.resize(canvas);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    // A resize clears the canvas.
    drawn = null;
    requestDraw();
  };
  const stopWatching = observeCanvas(canvas, resize, (seen) => {
    visible = seen;
    requestDraw();
  });
  controls.addEventListener("change", requestDraw);
  resize();
  resetView();

  return {
    show(measured, target, moving = false) {
      if (moving) quality.move();
      else quality.rest();
      requested = { measured, target: target !== null && differs(measured, target) ? target : null };
      const pxPerM = canvas.height / (2 * Math.tan(radians(camera.fov) / 2)) / nearest(camera, controls.target, home.reach);
      const seen = (next: Targets | null, last: Targets | null): boolean => isVisibleChange(last, next, home.reach, pxPerM);
      if (drawn === null || seen(measured, drawn.measured) || seen(requested.target, drawn.target)) requestDraw();
    },
    recolour() {
      scene.remove(grid);
      grid.dispose();
      grid = floor(scene, home);
      requestDraw();
    },
    resetView,
    dispose() {
      slot.dispose();
      quality.dispose();
      stopWatching();
      controls.dispose();
      robots.dispose();
      grid.dispose();
      renderer.dispose();
    },
  };
}

function createRenderer(canvas: HTMLCanvasElement): WebGLRenderer {
  try {
    const made = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    made.outputColorSpace = SRGBColorSpace;
    return made;
  } catch {
    throw new NoWebglError();
  }
}

interface Poses {
  measured: Targets;
  target: Targets | null;
}

/** The materials of a mesh: for a full and for a quick frame. */
interface Materials {
  mesh: Mesh<BufferGeometry, Material>;
  full: Material;
  quick: Material;
}

/** How well a view is drawn: on a slow machine, a moving view has half the resolution and simple shading. */
class Quality {
  readonly #renderer: WebGLRenderer;
  readonly #materials: readonly Materials[];
  #timer: ReturnType<typeof setTimeout> | undefined;
  #moving = false;
  #quick = false;
  #slowFrames = 0;
  #drawnAt = -Infinity;
  onRest = (): void => undefined;

  constructor(renderer: WebGLRenderer, materials: readonly Materials[]) {
    this.#renderer = renderer;
    this.#materials = materials;
  }

  get moving(): boolean {
    return this.#moving;
  }

  /** The view moves now. */
  move(): void {
    this.#moving = true;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.rest(), REST_MS);
  }

  /** The view no longer moves. */
  rest(): void {
    clearTimeout(this.#timer);
    this.#moving = false;
    this.#drawnAt = -Infinity;
    if (this.#quick) this.onRest();
  }

  /** Called before each frame. */
  apply(canvas: HTMLCanvasElement): void {
    const at = now();
    if (this.#moving && this.#slowFrames < SLOW_FRAMES) {
      const first = this.#drawnAt === -Infinity;
      this.#slowFrames = first ? this.#slowFrames : at - this.#drawnAt > SLOW_MS ? this.#slowFrames + 1 : 0;
    }
    if (this.#moving) this.#drawnAt = at;
    const quick = this.#moving && this.#slowFrames >= SLOW_FRAMES;
    if (quick === this.#quick) return;
    this.#quick = quick;
    for (const { mesh, ...materials } of this.#materials) mesh.material = quick ? materials.quick : materials.full;
    this.resize(canvas);
  }

  resize({ clientWidth, clientHeight }: HTMLCanvasElement): void {
    this.#renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * (this.#quick ? QUICK_RESOLUTION : 1));
    this.#renderer.setSize(clientWidth, clientHeight, false);
  }

  dispose(): void {
    clearTimeout(this.#timer);
  }
}

/** The robot's measured pose and the ghost of its target. */
function createRobots(scene: Scene, twin: KnownTwin): { pose: (shown: Poses) => void; materials: Materials[]; dispose: () => void } {
  const [full, quick] = [new Map<number, Material>(), new Map<number, Material>()];
  const solid = new RobotMeshes(twin, (alpha) => shared(full, alpha, () => new MeshStandardMaterial({ ...surface(alpha), roughness: 0.55, metalness: 0.1 })), { fixed: true });
  const material = new MeshBasicMaterial({ color: GHOST_COLOUR, transparent: true, opacity: GHOST_OPACITY, depthWrite: false });
  const ghost = new RobotMeshes(twin, () => material, { fixed: false });
  scene.add(solid.root, ghost.root);
  ghost.root.visible = false;
  const materials = solid.meshes.map((mesh): Materials => {
    const { opacity } = mesh.material;
    return { mesh, full: mesh.material, quick: shared(quick, opacity, () => new MeshLambertMaterial(surface(opacity))) };
  });
  return {
    materials,
    pose({ measured, target }) {
      solid.pose(measured);
      ghost.root.visible = target !== null;
      if (target !== null) ghost.pose(target);
    },
    dispose() {
      for (const { geometry } of [...solid.meshes, ...ghost.meshes]) geometry.dispose();
      for (const each of [material, ...full.values(), ...quick.values()]) each.dispose();
    },
  };
}

function surface(opacity: number): { vertexColors: true; transparent: boolean; opacity: number } {
  return { vertexColors: true, transparent: opacity < 1, opacity };
}

function shared(known: Map<number, Material>, alpha: number, create: () => Material): Material {
  const found = known.get(alpha) ?? create();
  known.set(alpha, found);
  return found;
}

function differs(measured: Targets, target: Targets): boolean {
  return Object.entries(target).some(([name, at]) => Math.abs(at - (measured[name] ?? at)) > GHOST_FROM);
}

/** Distance from the camera to the nearest part of the robot [m]. */
function nearest(camera: PerspectiveCamera, centre: Vector3, reach: number): number {
  return Math.max(0.1, camera.position.distanceTo(centre) - reach);
}

/** Reports size changes and visibility. Returns a function that ends it. */
function observeCanvas(canvas: HTMLCanvasElement, onResize: () => void, onVisible: (seen: boolean) => void): () => void {
  const sizes = new ResizeObserver(onResize);
  sizes.observe(canvas);
  const places = new IntersectionObserver((entries) => onVisible(entries.at(-1)?.isIntersecting ?? true));
  places.observe(canvas);
  return () => {
    sizes.disconnect();
    places.disconnect();
  };
}

/** Indices of the bodies that move. */
function moving(twin: KnownTwin): Set<number> {
  const found = new Set<number>();
  twin.bodies.forEach((body, index) => {
    if (body.joint !== null || found.has(body.parent)) found.add(index);
  });
  return found;
}

interface Frame {
  centre: Vector3;
  radius: number;
  floor: number;
  /** Maximum distance of a part from a joint that moves it [m]. */
  reach: number;
}

/** Centre and radius of a view that contains the whole robot, also when stretched out. */
function frame(twin: KnownTwin): Frame {
  const parts = moving(twin);
  const points = forward(twin, {}).flatMap(({ position_m, quaternion }, index) => {
    if (!parts.has(index)) return [];
    const ends = (twin.bodies[index]?.geometries ?? []).flatMap(endsOf);
    return [position_m, ...ends.map((end) => add(position_m, rotate(quaternion, end)))].map((at) => new Vector3(...at));
  });
  const base = points[0] ?? new Vector3();
  const reach = Math.max(0.2, ...points.map((point) => point.distanceTo(base)));
  // A legged robot's base is in its middle: include the parts below it.
  const below = Math.min(0, ...points.map((point) => point.z - base.z));
  const planes = twin.bodies.flatMap((body) => body.geometries.filter(({ shape: kind }) => kind === "plane"));
  return {
    centre: base.clone().add(new Vector3(0, 0, reach * 0.32 + below * 0.6)),
    radius: reach * 0.95,
    // Stretched out, it is longer than in its home pose.
    reach: 2 * reach,
    floor: planes[0]?.position_m[2] ?? 0,
  };
}

/** The two ends of a long shape in its body; otherwise the centre twice. */
function endsOf({ shape: kind, size_m, position_m, quaternion }: Geometry): Vector[] {
  const half = kind === "capsule" || kind === "cylinder" ? size_m[1] : 0;
  return [-half, half].map((along) => add(position_m, rotate(quaternion, [0, 0, along])));
}

function light(scene: Scene, radius: number): void {
  scene.add(new HemisphereLight(0xffffff, 0x8a94a0, 1.7));
  const sun = new DirectionalLight(0xffffff, 1.9);
  sun.position.set(2, -3, 4).multiplyScalar(radius);
  scene.add(sun);
  const fill = new DirectionalLight(0xffffff, 0.5);
  fill.position.set(-3, 2, 1).multiplyScalar(radius);
  scene.add(fill);
}

function floor(scene: Scene, { radius, floor: height }: Frame): GridHelper {
  const style = getComputedStyle(document.documentElement);
  const line = new Color(style.getPropertyValue("--line-strong").trim());
  const size = Math.ceil(radius * 2) * 2;
  const grid = new GridHelper(size, size * 4, line, line);
  grid.material.transparent = true;
  grid.material.opacity = 0.45;
  grid.rotateX(Math.PI / 2);
  grid.position.z = height;
  scene.add(grid);
  return grid;
}
