import { beforeEach, describe, expect, it } from "vitest";
import { LatencyProbe, SAMPLES_PER_KIND, probeKindsOf } from "../../../src/features/latency/model/probe";
import { PUBLISHED, UR5_TABLE_2, publishedFor } from "../../../src/features/latency/model/published-figures";
import { csv, distribution, figuresOf, linesOf, type Line } from "../../../src/features/latency/model/latency-stats";
import type { Sample, StoredLatency } from "../../../src/shared/api/latency";
import { deliver, device, link, pass, server } from "../../support/console";
import { none, ok, problem } from "../../support/fake-server";
import { DEVICE, description, listed } from "../../support/messages";

const stored = (more: Partial<StoredLatency> = {}): StoredLatency => ({
  transport: "mqtt", path: "command-started", count: 3, mean_ms: 2, max_ms: 3, p50_ms: 2, p95_ms: 3, p99_ms: 3,
  at_ms: [1000, 2000, 3000], ms: [3, 1, 2], ...more,
});
const ALL = { device: null, transport: null, path: null, sinceMs: 0 };
const samples = (...ms: number[]): Sample[] => ms.map((each, index) => ({ atMs: index, ms: each }));

describe("latency plots", () => {
  it("have one line for each device, transport and path, filtered by each and by time", () => {
    const all = new Map([
      ["a", [stored(), stored({ transport: "http", path: "operator-cloud" })]],
      ["b", [stored()]],
    ]);
    expect(linesOf(all, [], ALL)).toHaveLength(3);
    expect(linesOf(all, [], { ...ALL, device: "b" }).map((line) => line.device)).toEqual(["b"]);
    expect(linesOf(all, [], { ...ALL, transport: "http" })).toMatchObject([{ device: "a", path: "operator-cloud" }]);
    expect(linesOf(all, [], { ...ALL, path: "command-started" })).toHaveLength(2);
    const [recent] = linesOf(all, [], { ...ALL, device: "a", transport: "mqtt", sinceMs: 2000 });
    expect(recent?.samples).toEqual([{ atMs: 2000, ms: 1 }, { atMs: 3000, ms: 2 }]);
    expect(linesOf(all, [], { ...ALL, sinceMs: 4000 })).toEqual([]);
  });

  it("contain a sample of this page once, even after the cloud has returned it", () => {
    const measured = [{ atMs: 3000, ms: 2 }, { atMs: 2500, ms: 9 }];
    const unsaved: Line[] = [{ device: "a", transport: "mqtt", path: "command-started", samples: measured, stored: 0 }];
    const [line] = linesOf(new Map([["a", [stored()]]]), unsaved, ALL);
    expect(line?.samples.map(({ atMs }) => atMs)).toEqual([1000, 2000, 2500, 3000]);
  });

  it("show the statistics and the distribution of their samples", () => {
    const hundred = samples(...Array.from({ length: 100 }, (_, index) => 100 - index));
    expect(figuresOf(hundred)).toMatchObject({ count: 100, medianMs: 50, p95Ms: 95, p99Ms: 99, maxMs: 100, meanMs: 50.5 });
    expect(distribution(samples(2, 1, 2, 4))).toEqual([[1, 2, 4], [0.25, 0.75, 1]]);
  });

  it("are exported as CSV with a row for each sample, and no formulas", () => {
    const rows = csv(linesOf(new Map([["a", [stored()]]]), [], ALL), () => '=1+1, "x"').trimEnd().split("\r\n");
    expect(rows).toHaveLength(1 + 3);
    expect(rows[1]).toBe('a,"\'=1+1, ""x""",mqtt,command-started,1970-01-01T00:00:01.000Z,3');
  });

  it("show the papers' averages with comparable paths", () => {
    const mean = (all: readonly number[]): number => all.reduce((sum, each) => sum + each, 0) / all.length;
    for (const kind of ["http", "xmpp"] as const) {
      expect(mean(UR5_TABLE_2[kind])).toBeCloseTo(PUBLISHED.find(({ id }) => id === `ur5-${kind}`)?.ms ?? NaN, 6);
    }
    expect(publishedFor(null)).toBe(PUBLISHED);
    expect(publishedFor("received-started")).toEqual([]);
    expect(publishedFor("command-started").map(({ ms }) => ms)).toEqual([259, 86]);
  });
});

describe("a latency probe", () => {
  const HEALTH = "GET /health";
  const SHOOT = `POST /devices/${DEVICE}/actions`;
  const STORE = `POST /devices/${DEVICE}/latency`;
  let probe: LatencyProbe;

  beforeEach(() => {
    deliver("desc", { ...description, actions: ["shoot"] });
    server.on(HEALTH, ok({}));
    server.on(SHOOT, ok({ status: "done" }));
    server.on(STORE, none);
    probe = new LatencyProbe(server.api, link, device, () => null, 1);
  });

  async function run(...kinds: Parameters<LatencyProbe["run"]>[0]): Promise<void> {
    const finished = probe.run(kinds);
    await pass(1_000);
    await finished;
  }

  it("measures each path twenty times and stores each result once", async () => {
    await run("cloud", "broker", "device");
    expect([server.callsTo(HEALTH).length, link.pings, server.callsTo(SHOOT).length]).toEqual([SAMPLES_PER_KIND, SAMPLES_PER_KIND, SAMPLES_PER_KIND]);
    const paths = server.callsTo(STORE).map(({ body }) => [body["path"], (body["samples"] as object[]).length]);
    expect(paths).toEqual([["operator-cloud", SAMPLES_PER_KIND], ["operator-cloud", SAMPLES_PER_KIND], ["operator-device", SAMPLES_PER_KIND]]);
    await probe.store();
    expect(server.callsTo(STORE)).toHaveLength(3);
    expect(probe.lines.map((line) => line.samples.length)).toEqual([SAMPLES_PER_KIND, SAMPLES_PER_KIND, SAMPLES_PER_KIND]);
  });

  it("keeps the samples before a failure, and stores them later under the same key", async () => {
    server.on(STORE, problem(503, "busy", "Later, please."));
    const ping = link.ping.bind(link);
    link.ping = () => (link.pings === 3 ? Promise.reject(new Error("disconnected")) : ping());
    await run("broker");
    expect([probe.lines[0]?.samples.length, probe.unstored, probe.error.value]).toEqual([3, true, "Later, please."]);
    server.on(STORE, none);
    await probe.store();
    expect(probe.unstored).toBe(false);
    expect(new Set(server.callsTo(STORE).map(({ headers }) => headers["Idempotency-Key"])).size).toBe(1);
  });

  it("of a viewer stores nothing and sends nothing to the device", async () => {
    device.update(listed({ role: "viewer" }));
    expect(probeKindsOf(device)).toEqual(["cloud", "broker"]);
    await run("broker");
    expect([probe.lines[0]?.samples.length, server.callsTo(STORE).length]).toEqual([SAMPLES_PER_KIND, 0]);
  });
});
