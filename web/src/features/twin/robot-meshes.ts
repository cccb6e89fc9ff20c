/** The meshes of a robot: few, because without a graphics card each costs as much time as its surface. */
import {
  BoxGeometry, type BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, Float32BufferAttribute, Group, type Material, Matrix4, Mesh,
  type Object3D, PlaneGeometry, Quaternion, SphereGeometry, SRGBColorSpace, Vector3,
} from "three";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import type { Geometry } from "../../shared/mqtt/protocol.generated";
import type { Targets } from "../steering/model";
import { jointPosition, placementOf } from "./model/forward-kinematics";

/** The robot's root, for which `body` is the number of a fixed body without a moving parent. */
const ROOT = -1;

/** A body that moves relative to its parent, and the object that carries it. */
interface Moving {
  index: number;
  object: Object3D;
}

export class RobotMeshes {
  readonly root = new Group();
  readonly meshes: readonly Mesh<BufferGeometry, Material>[];
  readonly #twin: KnownTwin;
  readonly #moving: Moving[] = [];

  /** One mesh for each moving body and opacity, with the colours of its parts. `fixed`: with the parts that never move. */
  constructor(twin: KnownTwin, materialOf: (alpha: number) => Material, { fixed }: { fixed: boolean }) {
    this.#twin = twin;
    const objects = new Map<number, Object3D>([[ROOT, this.root]]);
    const parts = new Map<string, { owner: number; alpha: number; geometries: BufferGeometry[] }>();
    /** The moving body that carries each body, and the place of the body in it. */
    const carriers: { owner: number; place: Matrix4 }[] = [];
    for (const [index, body] of twin.bodies.entries()) {
      const parent = carriers[body.parent] ?? { owner: ROOT, place: new Matrix4() };
      const carrier = body.joint === null ? { owner: parent.owner, place: parent.place.clone().multiply(matrixOf(placementOf(body, 0))) } : { owner: index, place: new Matrix4() };
      carriers.push(carrier);
      if (body.joint !== null) objects.set(index, this.#addMoving(index, parent.place, objects.get(parent.owner) ?? this.root));
      for (const geometry of body.geometries) {
        // The grid is the floor.
        if (geometry.shape === "plane" || (carrier.owner === ROOT && !fixed)) continue;
        const [, , , alpha] = geometry.rgba;
        const key = `${carrier.owner} ${alpha}`;
        const part = parts.get(key) ?? { owner: carrier.owner, alpha, geometries: [] };
        parts.set(key, part);
        part.geometries.push(coloured(shape(geometry), geometry).applyMatrix4(carrier.place.clone().multiply(localMatrix(geometry))));
      }
    }
    this.meshes = [...parts.values()].map(({ owner, alpha, geometries }) => {
      const mesh = new Mesh<BufferGeometry, Material>(mergeGeometries(geometries), materialOf(alpha));
      geometries.forEach((each) => each.dispose());
      objects.get(owner)?.add(mesh);
      return mesh;
    });
    this.pose({});
  }

  /** Moves the bodies to positions of the joints [rad or m]. */
  pose(positions: Targets): void {
    for (const { index, object } of this.#moving) {
      const body = this.#twin.bodies[index];
      if (body === undefined) continue;
      const { position_m, quaternion } = placementOf(body, jointPosition(body.joint, positions));
      const [w, x, y, z] = quaternion;
      object.position.set(...position_m);
      object.quaternion.set(x, y, z, w);
    }
  }

  #addMoving(index: number, place: Matrix4, carrier: Object3D): Object3D {
    const holder = new Group();
    holder.matrixAutoUpdate = false;
    holder.matrix.copy(place);
    const object = new Group();
    holder.add(object);
    carrier.add(holder);
    this.#moving.push({ index, object });
    return object;
  }
}

function matrixOf({ position_m, quaternion: [w, x, y, z] }: ReturnType<typeof placementOf>, scale = new Vector3(1, 1, 1)): Matrix4 {
  return new Matrix4().compose(new Vector3(...position_m), new Quaternion(x, y, z, w).normalize(), scale);
}

/** The place of a geometry in its body. */
function localMatrix({ shape: kind, size_m, position_m, quaternion }: Geometry): Matrix4 {
  return matrixOf({ position_m, quaternion }, kind === "ellipsoid" ? new Vector3(...size_m) : undefined);
}

/** The same geometry with the colour of its part at each vertex. */
function coloured(geometry: BufferGeometry, { rgba: [red, green, blue] }: Geometry): BufferGeometry {
  const { r, g, b } = new Color().setRGB(red, green, blue, SRGBColorSpace);
  const count = geometry.getAttribute("position").count;
  geometry.setAttribute("color", new Float32BufferAttribute(Array.from({ length: count }, () => [r, g, b]).flat(), 3));
  return geometry.deleteAttribute("uv");
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
