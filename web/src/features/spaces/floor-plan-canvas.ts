import { type Extent, type Floor } from "./model/room-perception";
import { colour } from "../../shared/ui/canvas-theme";
import { bonesOf } from "../../shared/lib/skeleton";
import type { KnownPerson } from "../../shared/mqtt/sensor-frames";
import type { Trail } from "./floor-plan";
import type { LiveSensors } from "./model/sightings";

/** Radius of the circle around a tracked person [m]. */
const PERSON_M = 0.35;

export function paint(
  context: CanvasRenderingContext2D,
  width: number,
  height: number,
  room: Extent,
  floor: Floor | null,
  trails: ReadonlyMap<string, Trail>,
  seen: LiveSensors,
): void {
  const scale = width / (room.highX - room.lowX);
  const x = (m: number): number => (m - room.lowX) * scale;
  const y = (m: number): number => height - (m - room.lowY) * scale;
  if (floor !== null) paintFloor(context, floor, x, y, scale);
  paintMetres(context, room, x, y, width, height);
  context.lineWidth = 2;
  context.lineJoin = "round";
  [...trails.keys()].sort().forEach((name, index) => {
    const trail = trails.get(name) ?? [];
    context.strokeStyle = colour(`--series-${(index % 8) + 1}`);
    context.globalAlpha = 0.45;
    context.beginPath();
    for (const point of trail) context.lineTo(x(point.x), y(point.y));
    context.stroke();
  });
  context.globalAlpha = 1;
  // A light edge, because most echoes are on occupied cells.
  for (const [name, side] of [["--surface", 5], ["--series-2", 3]] as const) {
    context.fillStyle = colour(name);
    for (const [east, north] of seen.echoes) context.fillRect(x(east) - side / 2, y(north) - side / 2, side, side);
  }
  for (const person of seen.people) paintPerson(context, person, x, y, scale);
}

/** A tracked person from above: a circle and the bones, dashed where the sensor infers them. */
function paintPerson(
  context: CanvasRenderingContext2D,
  person: KnownPerson,
  x: (m: number) => number,
  y: (m: number) => number,
  scale: number,
): void {
  const [east, north] = person.position_m;
  context.strokeStyle = colour("--text");
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(x(east), y(north), PERSON_M * scale, 0, 2 * Math.PI);
  context.stroke();
  context.lineWidth = 2;
  for (const { from, to, tracked } of bonesOf(person)) {
    context.setLineDash(tracked ? [] : [2, 3]);
    context.beginPath();
    context.moveTo(x(from[0]), y(from[1]));
    context.lineTo(x(to[0]), y(to[1]));
    context.stroke();
  }
  context.setLineDash([]);
}

function paintFloor(
  context: CanvasRenderingContext2D,
  floor: Floor,
  x: (m: number) => number,
  y: (m: number) => number,
  scale: number,
): void {
  const fills = { free: colour("--surface"), taken: colour("--plan-taken"), unknown: colour("--plan-unknown") };
  const side = floor.sideM * scale;
  for (let row = 0; row < floor.rows; row += 1) {
    for (let column = 0; column < floor.columns; column += 1) {
      context.fillStyle = fills[floor.cell(column, row)];
      const [left, top] = [x(floor.lowerXM + column * floor.sideM), y(floor.lowerYM + (row + 1) * floor.sideM)];
      // Slightly larger than the cell, to avoid visible gaps.
      context.fillRect(left, top, side + 0.6, side + 0.6);
    }
  }
}

function paintMetres(
  context: CanvasRenderingContext2D,
  room: Extent,
  x: (m: number) => number,
  y: (m: number) => number,
  width: number,
  height: number,
): void {
  context.strokeStyle = colour("--quiet");
  context.globalAlpha = 0.18;
  context.lineWidth = 1;
  context.beginPath();
  for (let m = Math.ceil(room.lowX); m <= room.highX; m += 1) {
    context.moveTo(x(m), 0);
    context.lineTo(x(m), height);
  }
  for (let m = Math.ceil(room.lowY); m <= room.highY; m += 1) {
    context.moveTo(0, y(m));
    context.lineTo(width, y(m));
  }
  context.stroke();
  context.globalAlpha = 1;
}
