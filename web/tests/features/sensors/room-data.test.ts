import { readFileSync } from "node:fs";
import { deflateSync } from "node:zlib";
import { afterEach, describe, expect, it, vi } from "vitest";
import { assess, quantityOf } from "../../../src/features/sensors/model/quantities";
import { Recording } from "../../../src/features/sensors/model/stored-series";
import { separatePins, extent, readFloor, readPlaces } from "../../../src/features/spaces/model/room-perception";
import { readDepth } from "../../../src/shared/lib/png";
import { MessageError } from "../../../src/shared/mqtt/checks";
import { readApplied, readDescription, readMeasurements, readShot } from "../../../src/shared/mqtt/parse-messages";
import { bytes } from "../../support/messages";

afterEach(() => void vi.unstubAllGlobals());

const LIMITS = { low: 5, warning_low: 18, warning_high: 26, high: 35 };
const thermometer = readDescription(
  bytes({
    device: "thermometer",
    kind: "thermometer",
    robot_type: "thermometer",
    label: "Temperature",
    streams: [{ name: "temperature", rate_hz: 0.5 }],
    controls: [{ name: "pan", label: "Pan", unit: "rad", lower: -1.4, upper: 1.4 }],
    position_m: [0.15, -2.47, 1.4],
    diagnostics: [{ stream: "temperature", fields: "temperature_c*", label: "Room temperature", unit: "°C", ...LIMITS }],
  }),
);

describe("messages of a room device", () => {
  it("contain its position and limits, if it has any", () => {
    expect(thermometer.position_m).toEqual([0.15, -2.47, 1.4]);
    expect(thermometer.diagnostics[0]).toMatchObject({ warning_high: 26, advice: "" });
    const bare = readDescription(bytes({ device: "a", kind: "a", robot_type: "a", label: "A" }));
    expect([bare.position_m, bare.diagnostics]).toEqual([null, []]);
  });

  it("contain up to 128 finite numbers and states", () => {
    const message = (values: object): Uint8Array => bytes({ tick_ms: 1, at_ms: 2, sequence: 3, values });
    expect(readMeasurements(message({ open: true, range_m: 1.5 })).values).toEqual({ open: true, range_m: 1.5 });
    const many = Object.fromEntries(Array.from({ length: 129 }, (_, index) => [`v${index}`, 1]));
    const infinite = '{"tick_ms":1,"at_ms":2,"sequence":3,"values":{"a":1e999}}';
    for (const payload of [message({ open: "yes" }), message(many), bytes(infinite)]) {
      expect(() => readMeasurements(payload)).toThrow(MessageError);
    }
  });

  it("contain the results of actions", () => {
    expect(readShot({ values: { light: { light_lux: 5 } } })).toEqual({ light: { light_lux: 5 } });
    expect(readApplied({ applied: { level: 0.5 } })).toEqual({ level: 0.5 });
    expect(() => readShot({ values: { light: 5 } })).toThrow(MessageError);
    expect(() => readApplied({})).toThrow(MessageError);
  });
});

const Decompression = DecompressionStream;

/** A 16-bit greyscale PNG whose rows use the five filters in turn. */
function png(rows: number[][], bits = 16): Uint8Array {
  const plain = rows.map((row) => row.flatMap((value) => [value >> 8, value & 255]));
  const filtered = plain.flatMap((row, y) => {
    const coded = row.map((value, x) => {
      const [left = 0, up = 0, corner = 0] = [row[x - 2], plain[y - 1]?.[x], plain[y - 1]?.[x - 2]];
      const guess = left + up - corner;
      const [a, b, c] = [Math.abs(guess - left), Math.abs(guess - up), Math.abs(guess - corner)];
      const paeth = a <= b && a <= c ? left : b <= c ? up : corner;
      return (value - ([0, left, up, (left + up) >> 1, paeth][y % 5] ?? 0)) & 255;
    });
    return [y % 5, ...coded];
  });
  return pngFile(rows[0]?.length ?? 0, rows.length, Uint8Array.from(filtered), bits);
}

/** A PNG file with these rows. */
function pngFile(width: number, height: number, filtered: Uint8Array, bits = 16): Uint8Array {
  const uint32 = (value: number): number[] => [24, 16, 8, 0].map((shift) => (value >> shift) & 255);
  const chunk = (kind: string, body: Iterable<number>): number[] => {
    const content = [...body];
    return [...uint32(content.length), ...new TextEncoder().encode(kind), ...content, 0, 0, 0, 0];
  };
  const header = [...uint32(width), ...uint32(height), bits, 0, 0, 0, 0];
  return Uint8Array.from([
    ...[0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a],
    ...chunk("IHDR", header),
    ...chunk("IDAT", deflateSync(filtered)),
    ...chunk("IEND", []),
  ]);
}

describe("a depth image", () => {
  it("is decoded with all sixteen bits and every filter", async () => {
    const rows = Array.from({ length: 7 }, (_, y) => Array.from({ length: 5 }, (__, x) => (y * 4001 + x * 977) % 65_536));
    const image = await readDepth(png(rows));
    expect([image.width, image.height]).toEqual([5, 7]);
    rows.flat().forEach((mm, index) => expect(image.depthM[index]).toBeCloseTo(mm / 1000, 4));
  });

  it("is rejected if it is truncated, damaged or of another kind", async () => {
    const whole = png([[1, 2]]);
    const damaged = whole.map((byte, index) => (index > 45 && index < 55 ? 255 : byte));
    for (const content of [whole.slice(0, -20), damaged]) await expect(readDepth(content)).rejects.toThrow(MessageError);
    await expect(readDepth(png([[1, 2]], 8))).rejects.toThrow("16-bit");
    await expect(readDepth(Uint8Array.from([1, 2, 3]))).rejects.toThrow("not a PNG");
  });

  it("is rejected with missing or excess rows", async () => {
    await expect(readDepth(pngFile(2, 2, new Uint8Array(9)))).rejects.toThrow("corrupt");
    await expect(readDepth(pngFile(2, 2, new Uint8Array(11)))).rejects.toThrow("corrupt");
    expect((await readDepth(pngFile(2, 2, new Uint8Array(10)))).depthM).toHaveLength(4);
  });

  it("is decompressed no further than its size", async () => {
    const file = pngFile(100, 100, new Uint8Array(50_000_000));
    let decompressed = 0;
    const counted = class {
      readonly #real = new Decompression("deflate");
      readonly #counter = new TransformStream<Uint8Array, Uint8Array>({
        transform: (part, controller) => {
          decompressed += part.length;
          controller.enqueue(part);
        },
      });
      readonly writable = this.#real.writable;
      readonly readable = this.#real.readable.pipeThrough(this.#counter);
    };
    vi.stubGlobal("DecompressionStream", counted);
    await expect(readDepth(file)).rejects.toThrow("corrupt");
    // What a stream decompresses in advance is allowed.
    expect(decompressed).toBeLessThan(2_000_000);
  });
});

describe("a floor plan", () => {
  it("shows complete positions, with a direction if it is known", () => {
    const places = readPlaces({ "x_m.nao": 1, "y_m.nao": 2, "age_s.nao": 0.1, "yaw_rad.nao": 3, "x_m.ur5": 0, "y_m.ur5": 1, "x_m.lost": 9 });
    expect(places.map(({ name, yawRad }) => [name, yawRad])).toEqual([["nao", 3], ["ur5", null]]);
  });

  it("shows occupied and unobserved cells, also beyond 32 columns", () => {
    const grid = { lower_x_m: -3, lower_y_m: -2, side_m: 0.2, columns: 48, rows: 2 };
    const floor = readFloor({ ...grid, "taken_bits.0": 2 ** 47 + 1, "unknown_bits.0": 2, "taken_bits.1": 0, "unknown_bits.1": 0 });
    expect([0, 1, 2, 46, 47].map((column) => floor?.cell(column, 0))).toEqual(["taken", "unknown", "free", "free", "taken"]);
    expect(floor?.cell(0, 1)).toBe("free");
    expect(readFloor({ ...grid, rows: 3 })?.cell(0, 2)).toBe("unknown");
    for (const invalid of [{ ...grid, side_m: 0 }, { ...grid, columns: 1e9 }, {}]) expect(readFloor(invalid)).toBeNull();
  });

  it("includes devices outside the occupancy grid", () => {
    const floor = readFloor({ lower_x_m: 0, lower_y_m: 0, side_m: 1, columns: 4, rows: 3 });
    expect(extent(floor === null ? [] : [floor], [[5, -1]])).toEqual({ lowX: 0, lowY: -1, highX: 5, highY: 3 });
    expect(extent([], [])).toBeNull();
    expect(extent([], [[2, 2]])).toEqual({ lowX: 1.5, lowY: 1.5, highX: 2.5, highY: 2.5 });
  });

  it("moves overlapping pins apart, but not out of the plan", () => {
    const pins = separatePins(Array.from({ length: 12 }, () => [100, 100] as const), 25);
    expect(pins[0]).toEqual([100, 100]);
    pins.forEach(([x, y], index) => {
      for (const [otherX, otherY] of pins.slice(0, index)) expect(Math.hypot(x - otherX, y - otherY)).toBeGreaterThan(24);
    });
    for (const [x, y] of separatePins(Array.from({ length: 12 }, () => [12, 290] as const), 25, [360, 302])) {
      expect(x >= 11.5 && y >= 11.5 && x <= 348.5 && y <= 290.5).toBe(true);
    }
  });
});

describe("a measured value", () => {
  it("has the name, unit and limits of the room, or those of its field name", () => {
    const [described, plain, part, pan] = [["temperature", "temperature_c"], ["light", "light_lux"], ["presence", "people.door"], ["settings", "pan"]].map(
      ([stream = "", field = ""]) => quantityOf(thermometer, stream, field),
    );
    expect(described).toMatchObject({ label: "Room temperature", unit: "°C", limits: LIMITS });
    expect(plain).toMatchObject({ label: "Light", unit: "lx", limits: null });
    expect(part?.label).toBe("People · door");
    expect(pan).toMatchObject({ label: "Pan", unit: "°" });
    expect(pan?.toDisplay(Math.PI)).toBeCloseTo(180);
  });

  it("is compared with its limits, if there are any", () => {
    const { limits } = quantityOf(thermometer, "temperature", "temperature_c");
    expect([20, 17, 27, 4, 36].map((value) => assess(value, limits))).toEqual(["normal", "warning", "warning", "outside", "outside"]);
    expect(assess(1e6, null)).toBe("normal");
    expect(assess(-40, limits === null ? null : { ...limits, low: null, warning_low: null })).toBe("normal");
  });
});

describe("a recording", () => {
  const series = (at_ms: number[], mean: number[], span_ms = 0, min: number[] = [], max: number[] = []) => ({
    resolution: "raw",
    span_ms,
    at_ms,
    fields: { open: { mean, min, max, last: [] } },
  });

  it("joins stored and received samples without duplicates", () => {
    const recording = new Recording();
    recording.add(3000, 30);
    recording.add(4000, 40);
    recording.add(4000, 41);
    recording.load(series([1000, 2000, 3000], [10, 20, 30]), "open");
    expect(recording.samples(0).map(({ at, mean }) => at / 100 === mean)).toEqual([true, true, true, true]);
  });

  it("shows a pause as a gap", () => {
    const recording = new Recording();
    for (const at of [0, 100, 200, 300, 400, 500, 600, 700, 800, 900, 9000, 9100]) recording.add(at, 1);
    expect(recording.columns(0)[1].filter((value) => value === null)).toHaveLength(1);
  });

  it("reports the start of the current state, or its lower bound", () => {
    const recording = new Recording();
    expect(recording.since()).toBeNull();
    recording.load(series([1000, 2000, 3000], [0, 1, 1]), "open");
    expect(recording.since()).toEqual({ at: 2000, atLeast: false });
    recording.load(series([1000, 2000, 3000], [0.5, 1, 1], 1000, [0, 1, 1], [1, 1, 1]), "open");
    expect(recording.since()).toEqual({ at: 2000, atLeast: false });
    recording.add(4000, 0);
    expect(recording.since()).toEqual({ at: 4000, atLeast: false });
    recording.load(series([], []), "open");
    expect(recording.since()).toEqual({ at: 4000, atLeast: true });
  });
});

describe("the colours of a floor plan", () => {
  const style = readFileSync(new URL("../../../src/shared/ui/styles/tokens.css", import.meta.url), "utf8");

  function luminance(hex: string): number {
    const [red = 0, green = 0, blue = 0] = [1, 3, 5]
      .map((at) => parseInt(hex.slice(at, at + 2), 16) / 255)
      .map((part) => (part <= 0.03928 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  }

  it.each(["light", "dark"])("have enough contrast in the %s scheme", (scheme) => {
    const contrast = (...names: string[]): number => {
      const values = names.map((name) => [...style.matchAll(new RegExp(`--${name}: (#[0-9a-f]{6})`, "g"))][scheme === "light" ? 0 : 1]?.[1] ?? "");
      const [light = 0, dark = 0] = values.map(luminance).sort((a, b) => b - a);
      return (light + 0.05) / (dark + 0.05);
    };
    expect(contrast("plan-taken", "surface")).toBeGreaterThan(3);
    expect(contrast("plan-taken", "plan-unknown")).toBeGreaterThan(3);
    expect(contrast("accent", "surface")).toBeGreaterThan(4.5);
  });
});
