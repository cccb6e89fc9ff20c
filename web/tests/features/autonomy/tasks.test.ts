import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { conditionOf, MAX_SEED, rateText, seedOf, TrialHistory } from "../../../src/features/autonomy/model";
import type { Rate, Trial, TrialFilter } from "../../../src/shared/api/tasks";
import { FakeServer, ok, problem } from "../../support/fake-server";

const rate = (trials: number, successes: number, lower: number, upper: number): Rate => ({
  trials, successes, unknown: 0, rate: trials === 0 ? null : successes / trials, lower, upper,
});

describe("the condition in words", () => {
  it("names object, region, height and time of a simulated task", () => {
    const success = { object: "red_cube", region: "green_tray", rest_s: 1, lifted_m: 0.05 };
    expect(conditionOf({ success, observed: "simulation" })).toBe(
      "The robot lifts the red cube by at least 50 mm. Then the red cube is at rest in the green tray for 1 s, and the robot does not touch the red cube.",
    );
  });

  it.each([
    [{ above: 0.5 }, "is above 0.5"],
    [{ below: 3 }, "is below 3"],
    [{ equals: true }, "is true"],
    [{ equals: false }, "is false"],
  ])("names the measurement and its comparison %o", (comparison, text) => {
    const success = { device: "scale", stream: "weight", field: "mass_kg", rest_s: 2, stale_s: 1, ...comparison };
    const words = conditionOf({ success, observed: "measurement" });
    expect(words).toContain(`The value mass_kg of the stream weight of the device scale ${text} for 2 s.`);
    expect(words).toContain("older than 1 s");
    expect(words).not.toContain("In addition");
  });

  it("names a joint and its position", () => {
    expect(conditionOf({ success: { joint: "drawer", at_least: 0.15, rest_s: 1 }, observed: "simulation" })).toBe(
      "The robot moves the drawer to a position of at least 0.15. Then the drawer is at rest for 1 s.",
    );
  });

  it("names an object that the robot holds", () => {
    expect(conditionOf({ success: { object: "cube", lifted_m: 0.1, rest_s: 2 }, observed: "simulation" })).toBe(
      "The robot lifts the cube by at least 100 mm. It holds the cube there for 2 s.",
    );
  });

  it("names the point of an object that must be in the region", () => {
    const success = { object: "peg", region: "hole", rest_s: 1 };
    expect(conditionOf({ success: { ...success, point_m: [0, 0, -0.05] }, observed: "simulation" })).toBe(
      "Then the point [0,0,-0.05] m of the peg is at rest in the hole for 1 s, and the robot does not touch the peg.",
    );
    expect(conditionOf({ success: { ...success, point_m: [0, 0, 0] }, observed: "simulation" })).toMatch(/^Then the peg is at rest/);
  });

  it("lists fields that this console does not know instead of hiding them", () => {
    expect(conditionOf({ success: { object: "drawer", above_m: 0.15, rest_s: 1 }, observed: "simulation" })).toBe(
      "object = drawer, above_m = 0.15, rest_s = 1.",
    );
    expect(conditionOf({ success: { joint: "door", at_least: 1, rest_s: 1, axes: [0, 1] }, observed: "simulation" })).toMatch(/In addition: axes = \[0,1\]\.$/);
    expect(conditionOf({ success: {}, observed: "simulation" })).toBe("");
  });
});

describe("a success rate", () => {
  it("is shown with its interval", () => {
    expect(rateText(rate(10, 9, 0.5958, 0.9821))).toBe("9 of 10 (90 %), 95 % interval 59.6 % to 98.2 %");
  });

  it("is unknown without a verdict", () => {
    expect(rateText(rate(0, 0, 0, 1))).toBe("no trials with a verdict");
  });
});

describe("a seed", () => {
  it.each<[string, number | null | undefined]>([
    ["", null], ["  ", null], ["0", 0], [" 42 ", 42], [String(MAX_SEED), MAX_SEED],
    [String(MAX_SEED + 1), undefined], ["-1", undefined], ["1.5", undefined], ["seven", undefined], ["Infinity", undefined],
  ])("%o is read as %o", (text, seed) => {
    expect(seedOf(text)).toBe(seed);
  });
});

describe("the trials of a task", () => {
  const ROUTE = "GET /robot-types/ur5_gripper/tasks/cube/trials";
  const trial = (number: number, more: Partial<Trial> = {}): Trial => ({
    action: `action${number}`, device: "a-arm", state: "success", cause: "", detail: "", seed: number, epoch: number, caller: "demo",
    started_at: "2026-03-01T10:00:00Z", ended_at: null, duration_s: 1, movement: "place", movement_version: 1, simulated: true, software: "1",
    type_version: 1, ...more,
  });
  let server: FakeServer;
  let newest: number;

  beforeEach(() => {
    server = new FakeServer();
    newest = 50;
    server.on(ROUTE, ({ query }) => {
      const first = Number(query.get("cursor") ?? newest);
      const seeds = Array.from({ length: Math.min(first, Number(query.get("limit"))) }, (_, index) => first - index);
      const next = first - seeds.length;
      return ok({ items: seeds.map((seed) => trial(seed)), cursor: next === 0 ? null : String(next) });
    });
  });
  afterEach(() => void vi.unstubAllGlobals());

  const history = (filter: TrialFilter = { device: "", state: "" }): TrialHistory => new TrialHistory(server.api, "ur5_gripper", "cube", filter);
  const seeds = (of: TrialHistory): (number | null)[] => (of.trials.value ?? []).map(({ seed }) => seed);
  const down = (first: number, last: number): number[] => Array.from({ length: first - last + 1 }, (_, index) => first - index);

  it("are read page by page to their end", async () => {
    const trials = history();
    expect(trials.trials.value).toBeNull();
    await trials.refresh();
    expect([seeds(trials), trials.more.value]).toEqual([down(50, 31), "30"]);
    await trials.loadOlder();
    await trials.loadOlder();
    expect([seeds(trials), trials.more.value]).toEqual([down(50, 1), null]);
  });

  it("keep older pages when new trials start, and are replaced if they do not join", async () => {
    const trials = history();
    await trials.refresh();
    await trials.loadOlder();
    newest = 52;
    await trials.refresh();
    expect([seeds(trials), trials.more.value]).toEqual([down(52, 11), "10"]);
    newest = 90;
    await trials.refresh();
    expect([seeds(trials), trials.more.value]).toEqual([down(90, 71), "70"]);
  });

  it("show the verdict of a trial that was running", async () => {
    const trials = history();
    server.on(ROUTE, ok({ items: [trial(1, { state: "running" })], cursor: null }));
    await trials.refresh();
    server.on(ROUTE, ok({ items: [trial(1, { state: "failed", cause: "time_limit" })], cursor: null }));
    await trials.refresh();
    expect(trials.trials.value?.map(({ state, cause }) => [state, cause])).toEqual([["failed", "time_limit"]]);
  });

  it("are filtered by the server", async () => {
    await history({ device: "a-arm", state: "failed" }).refresh();
    await history().refresh();
    const [filtered, all] = server.callsTo(ROUTE).map(({ query }) => [query.get("device"), query.get("state")]);
    expect([filtered, all]).toEqual([["a-arm", "failed"], [null, null]]);
  });

  it("stay after an error", async () => {
    const trials = history();
    await trials.refresh();
    server.on(ROUTE, problem(503, "busy", "Later, please."));
    await trials.loadOlder();
    expect([seeds(trials), trials.error.value, trials.busy.value]).toEqual([down(50, 31), "Later, please.", false]);
  });
});
