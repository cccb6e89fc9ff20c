import { beforeEach, describe, expect, it } from "vitest";
import { changed, type EpisodeList, rated, removed, split, trimmed } from "../../../../src/features/autonomy/model/recording";
import { Episodes } from "../../../../src/features/autonomy/model/recording/episodes";
import { ApiError } from "../../../../src/shared/api/http";
import type { Episode } from "../../../../src/shared/api/recordings";

const episode = (start_s: number, end_s: number, more: Partial<Episode> = {}): Episode => ({ start_s, end_s, outcome: null, label: "", note: "", ...more });
const ranges = (list: EpisodeList): [number, number, Episode["outcome"]][] => list.map(({ start_s, end_s, outcome }) => [start_s, end_s, outcome]);

describe("rating", () => {
  it("marks the whole session if it has no episode", () => expect(ranges(rated([], 30, "success", 60))).toEqual([[0, 60, "success"]]));

  it("marks the free time around the cursor", () => {
    expect(ranges(rated([episode(40, 50), episode(0, 10)], 20, "failure", 60))).toEqual([[0, 10, null], [10, 40, "failure"], [40, 50, null]]);
  });

  it("changes the episode at the cursor, and the same rating again removes it", () => {
    const list = [episode(0, 10), episode(20, 30, { outcome: "success" })];
    expect(ranges(rated(list, 25, "failure", 60))).toEqual([[0, 10, null], [20, 30, "failure"]]);
    expect(ranges(rated(list, 25, "success", 60))).toEqual([[0, 10, null], [20, 30, null]]);
  });

  it("changes the later one of two episodes at their common end, as after a split", () => {
    const list = split([episode(0, 60, { outcome: "success" })], 20);
    expect(ranges(rated(list, 20, "failure", 60))).toEqual([[0, 20, "success"], [20, 60, "failure"]]);
  });

  it("adds no episode without a length", () => expect(rated([], 0, "success", 0)).toEqual([]));
});

describe("trimming", () => {
  const list = [episode(0, 10), episode(20, 30), episode(30, 40)];

  it.each([
    ["start_s", 15, [15, 30]],
    ["start_s", 5, [10, 30]],
    ["start_s", 50, [29.9, 30]],
    ["end_s", 25, [20, 25]],
    ["end_s", 35, [20, 30]],
    ["end_s", 0, [20, 20.1]],
  ] as const)("%s to %d ends at the neighbour and at the other end", (end, to, expected) => {
    const [, found] = trimmed(list, 1, end, to, 60);
    expect([found?.start_s, found?.end_s]).toEqual(expected);
  });

  it("ends at the session", () => expect(trimmed(list, 2, "end_s", 90, 60)[2]?.end_s).toBe(60));
});

it("splitting keeps the description, and does nothing outside an episode or at its ends", () => {
  const list = [episode(0, 10, { outcome: "success", label: "Pick" })];
  expect(split(list, 4)).toEqual([episode(0, 4, { outcome: "success", label: "Pick" }), episode(4, 10, { outcome: "success", label: "Pick" })]);
  for (const at of [0.05, 9.95, 20]) expect(split(list, at)).toBe(list);
});

it("changing and removing concern one episode", () => {
  const list = [episode(0, 10), episode(10, 20)];
  expect(changed(list, 1, { note: "Dropped" }).map(({ note }) => note)).toEqual(["", "Dropped"]);
  expect(removed(list, 0)).toEqual([episode(10, 20)]);
});

describe("saving", () => {
  let stored: EpisodeList;
  let version: number;
  let saves: EpisodeList[];
  let failure: Error | null;
  let episodes: Episodes;

  beforeEach(() => {
    [stored, version, saves, failure] = [[], 1, [], null];
    const save = async (list: EpisodeList, etag: string): Promise<string> => {
      await Promise.resolve();
      if (failure !== null) throw failure;
      if (etag !== String(version)) throw new ApiError(412, "precondition", "The episodes have changed.");
      saves.push(list);
      stored = list;
      version += 1;
      return String(version);
    };
    episodes = new Episodes(save, () => {
      episodes.adopt(stored, String(version));
      return Promise.resolve();
    });
    episodes.adopt([], "1");
  });

  it("stores each change with the version of the previous one", async () => {
    await episodes.commit([episode(0, 1)]);
    await episodes.commit([episode(0, 2)]);
    expect([stored, episodes.state.value, version]).toEqual([[episode(0, 2)], { kind: "saved" }, 3]);
  });

  it("stores changes that are made during a save after it", async () => {
    const first = episodes.commit([episode(0, 1)]);
    expect(episodes.state.value.kind).toBe("saving");
    void episodes.commit([episode(0, 2)]);
    await episodes.commit([episode(0, 3)]);
    await first;
    expect([saves, stored]).toEqual([[[episode(0, 1)], [episode(0, 3)]], [episode(0, 3)]]);
  });

  it("shows the other person's list after a conflict, and overwrites nothing", async () => {
    [stored, version] = [[episode(5, 6)], 9];
    await episodes.commit([episode(0, 1)]);
    expect([episodes.state.value.kind, episodes.list.value, stored, saves]).toEqual(["conflict", [episode(5, 6)], [episode(5, 6)], []]);
    await episodes.commit([...episodes.list.value, episode(7, 8)]);
    expect([episodes.state.value.kind, stored.length]).toEqual(["saved", 2]);
  });

  it("keeps the change after a failure, also when the page reads the session again, and stores it at the next try", async () => {
    failure = new ApiError(0, "unreachable", "The server cannot be reached.");
    await episodes.commit([episode(0, 1)]);
    expect(episodes.state.value).toEqual({ kind: "failed", reason: "The server cannot be reached." });
    episodes.adopt([], "1");
    expect(episodes.list.value).toEqual([episode(0, 1)]);
    failure = null;
    await episodes.commit();
    expect([stored, episodes.state.value.kind]).toEqual([[episode(0, 1)], "saved"]);
  });

  it("sends nothing during a drag, and one list at its end", async () => {
    for (const end of [1, 2, 3]) episodes.preview([episode(0, end)]);
    episodes.adopt([], "1");
    expect([saves, episodes.list.value]).toEqual([[], [episode(0, 3)]]);
    await episodes.commit();
    expect(saves).toEqual([[episode(0, 3)]]);
  });

  it("is refused without the version of the stored list", async () => {
    episodes.adopt([], null);
    await episodes.commit([episode(0, 1)]);
    expect([episodes.state.value.kind, saves]).toEqual(["failed", []]);
  });
});
