import { MessageError } from "../../../src/shared/mqtt/checks";
import { readFileSync } from "node:fs";
import { deflateSync } from "node:zlib";
import { describe, expect, it } from "vitest";
import { readFrame } from "../../../src/shared/mqtt/camera-frame";
import { readApplied, readDescription, readMeasurements, readScan, readShot, type KnownDiagnostic } from "../../../src/shared/mqtt/parse-messages";
import { readDepth } from "../../../src/shared/lib/png";
import { judge, quantityOf } from "../../../src/features/sensors/model/quantities";
import { apart, extent, readFloor, readPlaces } from "../../../src/features/spaces/model/room-perception";
import { Recording } from "../../../src/features/sensors/model/stored-series";

const bytes = (value: unknown): Uint8Array => new TextEncoder().encode(JSON.stringify(value));

const thermometer = readDescription(
  bytes({
    device: "thermometer",
    kind: "thermometer",
    robot_type: "thermometer",
    label: "Temperature",
    streams: [{ name: "temperature", rate_hz: 0.5 }],
    controls: [{ name: "pan", label: "Pan", unit: "rad", lower: -1.4, upper: 1.4 }],
    position_m: [0.15, -2.47, 1.4],
    diagnostics: [
      {
        stream: "temperature",
        fields: "temperature_c*",
        label: "Room temperature",
        unit: "°C",
        low: 5,
        warning_low: 18,
        warning_high: 26,
        high: 35,
      },
    ],
  }),
);

describe("what a room device says", () => {
  it("is read with where it hangs and how it is judged, or without", () => {
    expect(thermometer.position_m).toEqual([0.15, -2.47, 1.4]);
    expect(thermometer.diagnostics[0]).toMatchObject({ warning_high: 26, advice: "" });
    const bare = readDescription(bytes({ device: "a", kind: "a", robot_type: "a", label: "A" }));
    expect([bare.position_m, bare.diagnostics]).toEqual([null, []]);
  });

  it("is refused where it is no number and no state", () => {
    const told = { tick_ms: 1, at_ms: 2, sequence: 3, values: { open: true, range_m: 1.5 } };
    expect(readMeasurements(bytes(told)).values).toEqual({ open: true, range_m: 1.5 });
    expect(() => readMeasurements(bytes({ ...told, values: { open: "yes" } }))).toThrow(MessageError);
    expect(() => readMeasurements(new TextEncoder().encode('{"tick_ms":1,"at_ms":2,"sequence":3,"values":{"a":1e999}}'))).toThrow(MessageError);
    expect(() => readMeasurements(bytes({ ...told, values: Object.fromEntries(Array.from({ length: 129 }, (_, i) => [`v${i}`, 1])) }))).toThrow(
      MessageError,
    );
  });

  it("of results is read by the same rules", () => {
    expect(readShot({ values: { light: { light_lux: 5 } } })).toEqual({ light: { light_lux: 5 } });
    expect(readApplied({ applied: { level: 0.5 } })).toEqual({ level: 0.5 });
    expect(() => readShot({ values: { light: 5 } })).toThrow(MessageError);
    expect(() => readApplied({})).toThrow(MessageError);
  });
});

describe("a picture", () => {
  const header = [0x54, 0x53, 1, 1, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0x10, 0, 1, 0x40, 0, 0xf0];

  it("is read behind its header, wherever it lies in memory", () => {
    const payload = Uint8Array.from([9, 9, ...header, 0xff, 0xd8, 1, 2]).subarray(2);
    const frame = readFrame(payload);
    expect([frame.sequence, frame.tickMs, frame.width, frame.height]).toEqual([7, 4096, 320, 240]);
    expect([...frame.jpeg]).toEqual([0xff, 0xd8, 1, 2]);
  });

  it.each([
    ["another version", [0x54, 0x53, 2, ...header.slice(3), 0xff, 0xd8, 1]],
    ["no JPEG", [...header, 1, 2, 3]],
    ["nothing behind its header", header],
  ])("with %s is none", (_, payload) => {
    expect(() => readFrame(Uint8Array.from(payload))).toThrow(MessageError);
  });
});

/** A grey picture of 16 bits whose rows use the five filters in turn. */
function png(rows: number[][], bits = 16): Uint8Array {
  const width = rows[0]?.length ?? 0;
  const plain = rows.map((row) => row.flatMap((value) => [value >> 8, value & 255]));
  const filtered = plain.flatMap((row, y) => {
    const filter = y % 5;
    const coded = row.map((value, x) => {
      const left = x < 2 ? 0 : (row[x - 2] ?? 0);
      const up = plain[y - 1]?.[x] ?? 0;
      const corner = x < 2 ? 0 : (plain[y - 1]?.[x - 2] ?? 0);
      const guess = left + up - corner;
      const [a, b, c] = [Math.abs(guess - left), Math.abs(guess - up), Math.abs(guess - corner)];
      const paeth = a <= b && a <= c ? left : b <= c ? up : corner;
      return (value - ([0, left, up, (left + up) >> 1, paeth][filter] ?? 0)) & 255;
    });
    return [filter, ...coded];
  });
  const chunk = (kind: string, body: Uint8Array): number[] => {
    const length = new DataView(new ArrayBuffer(4));
    length.setUint32(0, body.length);
    return [...new Uint8Array(length.buffer), ...new TextEncoder().encode(kind), ...body, 0, 0, 0, 0];
  };
  const size = new DataView(new ArrayBuffer(13));
  size.setUint32(0, width);
  size.setUint32(4, rows.length);
  size.setUint8(8, bits);
  return Uint8Array.from([
    ...[0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a],
    ...chunk("IHDR", new Uint8Array(size.buffer)),
    ...chunk("IDAT", deflateSync(Uint8Array.from(filtered))),
    ...chunk("IEND", new Uint8Array()),
  ]);
}

describe("a depth picture", () => {
  it("keeps all its sixteen bits, by every filter", async () => {
    const rows = Array.from({ length: 7 }, (_, y) => Array.from({ length: 5 }, (_, x) => (y * 4001 + x * 977) % 65_536));
    const found = await readDepth(png(rows));
    expect([found.width, found.height]).toEqual([5, 7]);
    rows.flat().forEach((mm, index) => expect(found.depthM[index]).toBeCloseTo(mm / 1000, 4));
  });

  it("that is cut off, damaged or of another kind is refused", async () => {
    const whole = png([[1, 2]]);
    await expect(readDepth(whole.slice(0, -20))).rejects.toThrow(MessageError);
    await expect(readDepth(png([[1, 2]], 8))).rejects.toThrow("16 bits");
    await expect(readDepth(Uint8Array.from([1, 2, 3]))).rejects.toThrow("no PNG");
    const torn = whole.map((byte, index) => (index > 45 && index < 55 ? 255 : byte));
    await expect(readDepth(torn)).rejects.toThrow(MessageError);
  });
});

describe("a scan", () => {
  it("has a distance, or nothing, for each beam", () => {
    const scan = readScan(JSON.stringify({ at_ms: 1, angle_rad: [0, 1], range_m: [1.5, null], furthest_m: 12, more: 1 }));
    expect(scan.range_m).toEqual([1.5, null]);
    expect(() => readScan(JSON.stringify({ at_ms: 1, angle_rad: [0], range_m: [1, 2], furthest_m: 12 }))).toThrow(MessageError);
    expect(() => readScan("<html>")).toThrow("not JSON");
  });
});

describe("a room", () => {
  it("says who is where, and which way they go where they have gone", () => {
    const places = readPlaces({ "x_m.nao": 1, "y_m.nao": 2, "age_s.nao": 0.1, "yaw_rad.nao": 3, "x_m.ur5": 0, "y_m.ur5": 1, "x_m.lost": 9 });
    expect(places.map(({ name, yawRad }) => [name, yawRad])).toEqual([
      ["nao", 3],
      ["ur5", null],
    ]);
  });

  it("says which of its floor is taken, beyond the bits that a shift reaches", () => {
    const told = { lower_x_m: -3, lower_y_m: -2, side_m: 0.2, columns: 48, rows: 2 };
    const floor = readFloor({ ...told, "taken_bits.0": 2 ** 47 + 1, "unknown_bits.0": 2, "taken_bits.1": 0, "unknown_bits.1": 0 });
    expect([0, 1, 2, 46, 47].map((column) => floor?.cell(column, 0))).toEqual(["taken", "unknown", "free", "free", "taken"]);
    expect(floor?.cell(0, 1)).toBe("free");
    expect(readFloor({ ...told, rows: 3 })?.cell(0, 2)).toBe("unknown");
    expect(readFloor({ ...told, side_m: 0 })).toBeNull();
    expect(readFloor({ ...told, columns: 1e9 })).toBeNull();
    expect(readFloor({})).toBeNull();
  });

  it("is shown whole, with what hangs beyond its floor", () => {
    const floor = readFloor({ lower_x_m: 0, lower_y_m: 0, side_m: 1, columns: 4, rows: 3 });
    expect(extent(floor === null ? [] : [floor], [[5, -1]])).toEqual({ lowX: 0, lowY: -1, highX: 5, highY: 3 });
    expect(extent([], [])).toBeNull();
    expect(extent([], [[2, 2]])).toEqual({ lowX: 1.5, lowY: 1.5, highX: 2.5, highY: 2.5 });
  });

  it("moves pins apart into the plan, never out of it", () => {
    for (const [x, y] of apart(Array.from({ length: 12 }, () => [12, 290] as const), 25, [360, 302])) {
      expect(x >= 11.5 && y >= 11.5 && x <= 348.5 && y <= 290.5).toBe(true);
    }
  });

  it("keeps pins of things in one place apart", () => {
    const pins = apart(Array.from({ length: 12 }, () => [100, 100] as const), 25);
    expect(pins[0]).toEqual([100, 100]);
    pins.forEach(([x, y], index) => {
      for (const [otherX, otherY] of pins.slice(0, index)) expect(Math.hypot(x - otherX, y - otherY)).toBeGreaterThan(24);
    });
  });
});

describe("a measured value", () => {
  it("has the name, unit and limits that its room gives, else those of its own name", () => {
    const known = quantityOf(thermometer, "temperature", "temperature_c");
    expect([known.label, known.unit, known.judged?.high]).toEqual(["Room temperature", "°C", 35]);
    const plain = quantityOf(thermometer, "light", "light_lux");
    expect([plain.label, plain.unit, plain.judged]).toEqual(["Light", "lx", null]);
    expect(quantityOf(thermometer, "presence", "people.door").label).toBe("People · door");
    const pan = quantityOf(thermometer, "settings", "pan");
    expect([pan.label, pan.unit, Math.round(pan.shown(Math.PI))]).toEqual(["Pan", "°", 180]);
  });

  it("is judged by its limits, where there are any", () => {
    const { judged } = quantityOf(thermometer, "temperature", "temperature_c");
    expect([20, 17, 27, 4, 36].map((value) => judge(value, judged))).toEqual(["well", "warning", "warning", "bad", "bad"]);
    expect(judge(1e6, null)).toBe("well");
    const open: KnownDiagnostic | null = judged === null ? null : { ...judged, low: null, warning_low: null };
    expect(judge(-40, open)).toBe("well");
  });
});

describe("a recording", () => {
  const series = (at_ms: number[], mean: number[], span_ms = 0, min: number[] = [], max: number[] = []) => ({
    resolution: "raw",
    span_ms,
    at_ms,
    fields: { open: { mean, min, max, last: [] } },
  });

  it("goes from what was stored to what was heard since, without either twice", () => {
    const recording = new Recording();
    recording.add(3000, 30);
    recording.add(4000, 40);
    recording.add(4000, 41);
    recording.load(series([1000, 2000, 3000], [10, 20, 30]), "open");
    expect(recording.samples(0).map(({ at, mean }) => [at, mean])).toEqual([
      [1000, 10],
      [2000, 20],
      [3000, 30],
      [4000, 40],
    ]);
  });

  it("shows a pause as a gap", () => {
    const recording = new Recording();
    for (const at of [0, 100, 200, 300, 400, 500, 600, 700, 800, 900, 9000, 9100]) recording.add(at, 1);
    expect(recording.columns(0)[1].filter((value) => value === null)).toHaveLength(1);
  });

  it("says since when a state has been as it is, or that it is longer than is known", () => {
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

describe("the colours of the page", () => {
  const style = readFileSync(new URL("../../../src/shared/ui/styles/tokens.css", import.meta.url), "utf8");
  const luminance = (hex: string): number => {
    const [red = 0, green = 0, blue = 0] = [1, 3, 5]
      .map((at) => parseInt(hex.slice(at, at + 2), 16) / 255)
      .map((one) => (one <= 0.03928 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const contrast = (one: string, other: string): number => {
    const [light = 0, dark = 0] = [luminance(one), luminance(other)].sort((a, b) => b - a);
    return (light + 0.05) / (dark + 0.05);
  };

  it.each([
    ["light", 0],
    ["dark", 1],
  ])("tell what is taken, free and not seen apart on a plan when %s", (_, scheme) => {
    const value = (name: string): string => [...style.matchAll(new RegExp(`--${name}: (#[0-9a-f]{6})`, "g"))][scheme]?.[1] ?? "";
    expect(contrast(value("plan-taken"), value("surface"))).toBeGreaterThan(3);
    expect(contrast(value("plan-taken"), value("plan-unknown"))).toBeGreaterThan(3);
    expect(contrast(value("accent"), value("surface"))).toBeGreaterThan(4.5);
  });
});
