/** The 3D view of a robot. Loaded on demand; draws only after changes. */
import type { Targets } from "../steering/model";
import {
  BoxGeometry, type BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, DirectionalLight, Group, GridHelper,
  HemisphereLight, Mesh, MeshBasicMaterial, MeshStandardMaterial, type Material, Object3D, PerspectiveCamera,
  PlaneGeometry, Scene, SphereGeometry, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { radians } from "../../shared/lib/angles";
import { isVisibleChange } from "./model/visible-change";
import { add, forward, placementOf, rotate, jointPosition } from "./model/forward-kinematics";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import type { Geometry } from "../../shared/mqtt/protocol.generated";
import type { Vector3 as Vector } from "../../shared/lib/vectors";
import { DrawSlot } from "../../shared/hooks/draw-scheduler";

export class NoWebglError extends Error {
  override name = "NoWebglError";
}

export interface LiveScene {
  /** Shows the measured pose, and the target's if it differs (`null`: none). */
  show(measured: Targets, target: Targets | null): void;
  /** Applies changed theme colours. */
  recolour(): void;
  resetView(): void;
  dispose(): void;
}

/** Closer to the measured pose than this, the target is not drawn [rad]. */
const GHOST_FROM = 0.005;
const GHOST_COLOUR = 0x2f8fe0;
const GHOST_OPACITY = 0.28;

type Robot = Object3D[];

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
  const slot = new DrawSlot(() => {
    robots.pose(requested);
    renderer.render(scene, camera);
    drawn = requested;
    onFrame();
  });
  // A view outside the viewport does not draw, except its first frame, so that scrolling never shows an empty view.
  const requestDraw = (): void => {
    if (visible || drawn === null) slot.request();
  };
  const resetView = (): void => {
    controls.target.copy(home.centre);
    camera.position.copy(home.centre).add(new Vector3(1.15, -1.5, 0.75).normalize().multiplyScalar(home.radius * 3.2));
    controls.update();
    requestDraw();
  };
  const resize = (): void => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
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
    show(measured, target) {
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
      stopWatching();
      controls.dispose();
      scene.traverse((object) => {
        if (!(object instanceof Mesh)) return;
        const mesh = object as Mesh<BufferGeometry, Material>;
        mesh.geometry.dispose();
        mesh.material.dispose();
      });
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

/** The robot's measured pose and the ghost of its target. */
function createRobots(scene: Scene, twin: KnownTwin): { pose: (shown: Poses) => void } {
  const solid = build(scene, twin, solidMaterial);
  const ghostRoot = new Group();
  scene.add(ghostRoot);
  const material = new MeshBasicMaterial({
    color: GHOST_COLOUR,
    transparent: true,
    opacity: GHOST_OPACITY,
    depthWrite: false,
  });
  const ghost = build(ghostRoot, twin, () => material, moving(twin));
  ghostRoot.visible = false;
  return {
    pose({ measured, target }) {
      pose(solid, twin, measured);
      ghostRoot.visible = target !== null;
      if (target !== null) pose(ghost, twin, target);
    },
  };
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

function solidMaterial(geometry: Geometry): Material {
  const [red, green, blue, alpha] = geometry.rgba;
  return new MeshStandardMaterial({
    color: new Color().setRGB(red, green, blue, SRGBColorSpace),
    roughness: 0.55,
    metalness: 0.1,
    transparent: alpha < 1,
    opacity: alpha,
  });
}

/** One object for each body, in the twin's order, nested in its parent. */
function build(
  root: Object3D,
  twin: KnownTwin,
  material: (geometry: Geometry) => Material,
  only?: ReadonlySet<number>,
): Robot {
  const bodies: Robot = [];
  for (const [index, body] of twin.bodies.entries()) {
    const object = new Group();
    for (const geometry of only?.has(index) === false ? [] : body.geometries) {
      if (geometry.shape === "plane") continue; // The grid is the floor.
      const mesh = new Mesh(shape(geometry), material(geometry));
      mesh.position.set(...geometry.position_m);
      const [w, x, y, z] = geometry.quaternion;
      mesh.quaternion.set(x, y, z, w).normalize();
      if (geometry.shape === "ellipsoid") mesh.scale.set(...geometry.size_m);
      object.add(mesh);
    }
    (bodies[body.parent] ?? root).add(object);
    bodies.push(object);
  }
  pose(bodies, twin, {});
  return bodies;
}

/** MuJoCo uses half sizes, and its capsules and cylinders lie along z; those of three.js along y. */
function shape({ shape: kind, size_m: [a, b, c] }: Geometry): BufferGeometry {
  switch (kind) {
    case "box":
      return new BoxGeometry(2 * a, 2 * b, 2 * c);
    case "sphere":
      return new SphereGeometry(a, 32, 20);
    case "ellipsoid":
      return new SphereGeometry(1, 32, 20);
    case "capsule":
      return new CapsuleGeometry(a, 2 * b, 10, 28).rotateX(Math.PI / 2);
    case "cylinder":
      return new CylinderGeometry(a, a, 2 * b, 36).rotateX(Math.PI / 2);
    case "plane":
      return new PlaneGeometry(2 * a, 2 * b);
  }
}

function pose(robot: Robot, twin: KnownTwin, positions: Targets): void {
  twin.bodies.forEach((body, index) => {
    const { position_m, quaternion } = placementOf(body, jointPosition(body.joint, positions));
    const [w, x, y, z] = quaternion;
    robot[index]?.position.set(...position_m);
    robot[index]?.quaternion.set(x, y, z, w);
  });
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
