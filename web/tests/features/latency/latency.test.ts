/** Times: what is drawn, what it comes to, what is saved; and the papers' figures. */
import type { Action, LatencyBatch } from "../../../src/shared/api/types";
import { LatencyApi, type Sample, type StoredLatency } from "../../../src/shared/api/latency";
import { signal } from "@preact/signals-core";
import { describe, expect, it } from "vitest";
import { Api } from "../../../src/shared/api/client";
import type { DeviceStore } from "../../../src/features/devices/model/device-store";
import { ApiError, Http } from "../../../src/shared/api/http";
import type { Link } from "../../../src/shared/mqtt/mqtt-link";
import { LatencyProbe, TIMES, probeKindsOf } from "../../../src/features/latency/model/probe";
import { PUBLISHED, publishedFor, UR5_TABLE_2 } from "../../../src/features/latency/model/published-figures";
import { csv, figuresOf, linesOf, distribution, type Line } from "../../../src/features/latency/model/latency-stats";

const stored = (more: Partial<StoredLatency> = {}): StoredLatency => ({
  transport: "mqtt",
  path: "command-started",
  count: 3,
  mean_ms: 2,
  max_ms: 3,
  p50_ms: 2,
  p95_ms: 3,
  p99_ms: 3,
  at_ms: [1000, 2000, 3000],
  ms: [3, 1, 2],
  ...more,
});
const ALL = { device: null, transport: null, path: null, sinceMs: 0 };
const samples = (...ms: number[]): Sample[] => ms.map((one, index) => ({ atMs: index, ms: one }));

describe("what is drawn", () => {
  it("is one line for each device, transport and path, filtered by each and by time", () => {
    const all = new Map([
      ["a", [stored(), stored({ transport: "http", path: "operator-cloud" })]],
      ["b", [stored()]],
    ]);
    expect(linesOf(all, [], ALL)).toHaveLength(3);
    expect(linesOf(all, [], { ...ALL, device: "b" }).map(({ device }) => device)).toEqual(["b"]);
    expect(linesOf(all, [], { ...ALL, transport: "http" })).toMatchObject([{ device: "a", path: "operator-cloud" }]);
    expect(linesOf(all, [], { ...ALL, path: "command-started" })).toHaveLength(2);
    expect(linesOf(all, [], { ...ALL, device: "a", transport: "mqtt", sinceMs: 2000 })[0]?.samples).toEqual([
      { atMs: 2000, ms: 1 },
      { atMs: 3000, ms: 2 },
    ]);
    expect(linesOf(all, [], { ...ALL, sinceMs: 4000 })).toEqual([]);
  });

  it("has what was measured here once, also when it has come back from the cloud", () => {
    const fresh: Line[] = [{ device: "a", transport: "mqtt", path: "command-started", samples: [{ atMs: 3000, ms: 2 }, { atMs: 2500, ms: 9 }], stored: 0 }];
    const [line] = linesOf(new Map([["a", [stored()]]]), fresh, ALL);
    expect(line?.samples.map(({ atMs }) => atMs)).toEqual([1000, 2000, 2500, 3000]);
  });
});

describe("figures", () => {
  it("are those of the samples", () => {
    const found = figuresOf(samples(...Array.from({ length: 100 }, (_, index) => 100 - index)));
    expect(found).toMatchObject({ count: 100, medianMs: 50, p95Ms: 95, p99Ms: 99, maxMs: 100, meanMs: 50.5 });
  });

  it("of shares rise to one, equal times together", () => {
    expect(distribution(samples(2, 1, 2, 4))).toEqual([
      [1, 2, 4],
      [0.25, 0.75, 1],
    ]);
  });
});

describe("the table for other programs", () => {
  it("has a row for each sample that is drawn, and no formulas", () => {
    const lines = linesOf(new Map([["a", [stored()]]]), [], ALL);
    const rows = csv(lines, () => '=1+1, "x"').trimEnd().split("\r\n");
    expect(rows).toHaveLength(1 + 3);
    expect(rows[1]).toBe('a,"\'=1+1, ""x""",mqtt,command-started,1970-01-01T00:00:01.000Z,3');
  });
});

describe("the papers' figures", () => {
  it("are the averages of the table as printed", () => {
    const mean = (all: readonly number[]): number => all.reduce((sum, one) => sum + one, 0) / all.length;
    expect(UR5_TABLE_2.http).toHaveLength(20);
    const printed = (id: string): number | undefined => PUBLISHED.find((one) => one.id === id)?.ms;
    expect(mean(UR5_TABLE_2.http)).toBeCloseTo(printed("ur5-http") ?? NaN, 6);
    expect(mean(UR5_TABLE_2.xmpp)).toBeCloseTo(printed("ur5-xmpp") ?? NaN, 6);
  });

  it("stand beside the parts that they can be held beside", () => {
    expect(publishedFor(null)).toBe(PUBLISHED);
    expect(publishedFor("received-started")).toEqual([]);
    expect(publishedFor("command-started").map(({ ms }) => ms)).toEqual([259, 86]);
  });
});

/** Answers what the test says, and keeps what was sent. */
class Desk extends Api {
  readonly asked: string[] = [];
  readonly sent: { path: string; count: number; key: string }[] = [];
  full = false;
  override readonly latency = new (class extends LatencyApi {
    readonly desk: Desk;
    constructor(desk: Desk) {
      super(new Http(""));
      this.desk = desk;
    }
    override ask(): Promise<void> {
      this.desk.asked.push("health");
      return Promise.resolve();
    }
  })(this);
  override addLatency(_: string, { path, samples: all }: LatencyBatch, key: string): Promise<void> {
    if (this.full) return Promise.reject(new ApiError(503, "busy", "Later, please."));
    this.sent.push({ path, count: all.length, key });
    return Promise.resolve();
  }
  override startAction(): Promise<Action> {
    this.asked.push("shoot");
    return Promise.resolve({ status: "done" } as Action);
  }
}

const link = (ping: () => Promise<void>): Link => ({ ping }) as Link;
const device = (role: string, actions: string[]): DeviceStore =>
  ({ id: "d", info: signal({ role }), description: signal({ actions }) }) as unknown as DeviceStore;

describe("measuring here", () => {
  it("asks each way twenty times, one after the other, and stores each once", async () => {
    const desk = new Desk();
    let pings = 0;
    const measure = new LatencyProbe(desk, link(() => Promise.resolve(void (pings += 1))), device("owner", ["shoot"]), () => null, 1);
    await measure.run(["cloud", "broker", "device"]);
    expect([desk.asked.length, pings]).toEqual([2 * TIMES, TIMES]);
    expect(desk.sent.map(({ path, count }) => [path, count])).toEqual([
      ["operator-cloud", TIMES],
      ["operator-cloud", TIMES],
      ["operator-device", TIMES],
    ]);
    await measure.store();
    expect(desk.sent).toHaveLength(3);
    expect(measure.lines.map(({ samples: all }) => all.length)).toEqual([TIMES, TIMES, TIMES]);
  });

  it("keeps what came before it failed or could not be stored, and stores it later under the same key", async () => {
    const desk = new Desk();
    desk.full = true;
    let pings = 0;
    const failing = (): Promise<void> => ((pings += 1) > 3 ? Promise.reject(new Error("gone")) : Promise.resolve());
    const measure = new LatencyProbe(desk, link(failing), device("owner", []), () => null, 1);
    await measure.run(["broker"]);
    expect([measure.lines[0]?.samples.length, measure.unstored, measure.why.value]).toEqual([3, true, "Later, please."]);
    desk.full = false;
    await measure.store();
    expect([desk.sent.length, measure.unstored]).toEqual([1, false]);
  });

  it("stores nothing for who only watches, and asks nothing of the device", async () => {
    const desk = new Desk();
    const watching = device("viewer", ["shoot"]);
    expect(probeKindsOf(watching)).toEqual(["cloud", "broker"]);
    const measure = new LatencyProbe(desk, link(() => Promise.resolve()), watching, () => null, 1);
    await measure.run(["broker"]);
    expect([measure.lines[0]?.samples.length, desk.sent.length]).toEqual([TIMES, 0]);
  });
});
