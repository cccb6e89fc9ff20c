/** Reads the perception streams of a room: positions and occupancy. */

export type Values = Readonly<Record<string, number | boolean>>;

/** A robot or person in the room at the time of the measurement. */
export interface Place {
  /** The robot's name at its agent, or `person`, `person-2`. */
  name: string;
  xM: number;
  yM: number;
  /** Age of the last observation [s]. */
  ageS: number;
  speedMS: number;
  /** Direction of motion, counter-clockwise from x; `null` before any motion. */
  yawRad: number | null;
}

type Cell = "free" | "taken" | "unknown";

/** The occupancy grid; row 0 has the lowest y. */
export interface Floor {
  lowerXM: number;
  lowerYM: number;
  sideM: number;
  columns: number;
  rows: number;
  cell: (column: number, row: number) => Cell;
}

const MAX_ROWS = 128;
/** A number represents this many bits exactly. */
const MAX_COLUMNS = 53;

/** The stream `positions`, by name. Entries without a coordinate are omitted. */
export function readPlaces(values: Values): Place[] {
  const names = Object.keys(values).flatMap((field) => (field.startsWith("x_m.") ? [field.slice("x_m.".length)] : []));
  return names.sort().flatMap((name) => {
    const [xM, yM] = [numeric(values[`x_m.${name}`]), numeric(values[`y_m.${name}`])];
    if (xM === null || yM === null) return [];
    const ageS = numeric(values[`age_s.${name}`]) ?? 0;
    const speedMS = numeric(values[`speed_m_s.${name}`]) ?? 0;
    return [{ name, xM, yM, ageS, speedMS, yawRad: numeric(values[`yaw_rad.${name}`]) }];
  });
}

/** The stream `occupancy`; `null` if invalid. */
export function readFloor(values: Values): Floor | null {
  const [lowerXM, lowerYM] = [numeric(values["lower_x_m"]), numeric(values["lower_y_m"])];
  const [sideM, columns, rows] = [numeric(values["side_m"]), numeric(values["columns"]), numeric(values["rows"])];
  if (lowerXM === null || lowerYM === null || sideM === null || columns === null || rows === null) return null;
  if (!(sideM > 0) || !isCount(columns, MAX_COLUMNS) || !isCount(rows, MAX_ROWS)) return null;
  const taken = bits(values, "taken_bits", rows);
  const unknown = bits(values, "unknown_bits", rows);
  const cell = (column: number, row: number): Cell => {
    if (isSet(taken[row], column)) return "taken";
    return unknown[row] === null || isSet(unknown[row], column) ? "unknown" : "free";
  };
  return { lowerXM, lowerYM, sideM, columns, rows, cell };
}

function bits(values: Values, name: string, rows: number): (number | null)[] {
  return Array.from({ length: rows }, (_, row) => numeric(values[`${name}.${row}`]));
}

/** Bits above 32 cannot be shifted. */
function isSet(row: number | null | undefined, column: number): boolean {
  return typeof row === "number" && Math.floor(row / 2 ** column) % 2 === 1;
}

function isCount(value: number, max: number): boolean {
  return Number.isInteger(value) && value >= 1 && value <= max;
}

function numeric(value: number | boolean | undefined): number | null {
  return typeof value === "number" ? value : null;
}

/** A rectangle of the room [m]. */
export interface Extent {
  lowX: number;
  lowY: number;
  highX: number;
  highY: number;
}

/** The rectangle that contains all floors and points; `null` without any. */
export function extent(floors: readonly Floor[], points: readonly (readonly [number, number])[]): Extent | null {
  const xs = points.map(([x]) => x);
  const ys = points.map(([, y]) => y);
  for (const floor of floors) {
    xs.push(floor.lowerXM, floor.lowerXM + floor.columns * floor.sideM);
    ys.push(floor.lowerYM, floor.lowerYM + floor.rows * floor.sideM);
  }
  if (xs.length === 0) return null;
  const found = { lowX: Math.min(...xs), lowY: Math.min(...ys), highX: Math.max(...xs), highY: Math.max(...ys) };
  // A single point is shown with a surrounding metre.
  const missing = Math.max(0, (1 - Math.max(found.highX - found.lowX, found.highY - found.lowY)) / 2);
  return { lowX: found.lowX - missing, lowY: found.lowY - missing, highX: found.highX + missing, highY: found.highY + missing };
}

/** Moves overlapping pins apart [px]. Each stays as near to its position as possible and inside the plan. */
export function separatePins(
  points: readonly (readonly [number, number])[],
  gap: number,
  [wide, high]: readonly [number, number] = [Infinity, Infinity],
): [number, number][] {
  const inside = ([x, y]: [number, number]): boolean =>
    x >= gap / 2 - 1 && y >= gap / 2 - 1 && x <= wide - gap / 2 + 1 && y <= high - gap / 2 + 1;
  const placed: [number, number][] = [];
  for (const [x, y] of points) placed.push(freePosition(x, y, placed, gap, inside));
  return placed;
}

function freePosition(
  x: number,
  y: number,
  placed: readonly [number, number][],
  gap: number,
  inside: (at: [number, number]) => boolean,
): [number, number] {
  const clear = ([atX, atY]: [number, number]): boolean =>
    inside([atX, atY]) &&
    placed.every(([otherX, otherY]) => Math.hypot(atX - otherX, atY - otherY) >= gap - 0.5);
  for (let ring = 0; ring < 12; ring += 1) {
    const steps = ring === 0 ? 1 : ring * 6;
    for (let step = 0; step < steps; step += 1) {
      const angle = (2 * Math.PI * step) / steps;
      const at: [number, number] = [x + ring * gap * Math.cos(angle), y + ring * gap * Math.sin(angle)];
      if (clear(at)) return at;
    }
  }
  return [x, y];
}
