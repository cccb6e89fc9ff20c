/** Frames of a stream from the subscription to the display, on virtual time. */
import { describe, expect, it } from "vitest";
import { currentFrame, followFrames, type Frames } from "../../../src/features/devices/model";
import { clock } from "../../../src/shared/lib/clock";
import { device, link, pass } from "../../support/console";
import { TOPIC } from "../../support/messages";

/** Delivers a lidar scan; its content is `{"` and the sequence. */
function frame(sequence: number): void {
  const header = [0x54, 0x53, 1, 3, 0, 0, 0, sequence, 0, 0, 0, 0, 0, 0, 0x10, 0, 1, 0x68, 0, 1];
  link.deliver(`${TOPIC}/cam/scan`, Uint8Array.from([...header, 0x7b, 0x22, sequence]));
}

const last = (content: Uint8Array): number => content.at(-1) ?? 0;

describe("the frames of a stream", () => {
  it("are forgotten at the end of the subscription, and no later frame is read", async () => {
    const published: Frames<number>[] = [];
    const read: number[] = [];
    const end = followFrames(device, "scan", "scan", (content) => read.push(last(content)), (frames) => published.push(frames));
    frame(1);
    await pass(0);
    expect(published.at(-1)?.latest?.sequence).toBe(1);
    expect(link.filters()).toContain(`${TOPIC}/cam/scan`);
    end();
    expect(published.at(-1)).toEqual({ latest: null, error: "" });
    expect(link.filters()).not.toContain(`${TOPIC}/cam/scan`);
    frame(2);
    await pass(0);
    expect(read).toEqual([1]);
    expect(published).toHaveLength(2);
  });

  it("are not published when the subscription ends while one is read", async () => {
    const published: Frames<number>[] = [];
    let finish: (value: number) => void = () => undefined;
    const end = followFrames(device, "scan", "scan", () => new Promise<number>((resolve) => (finish = resolve)), (frames) => published.push(frames));
    frame(1);
    end();
    finish(1);
    await pass(0);
    expect(published).toEqual([{ latest: null, error: "" }]);
  });

  it("have the arrival of the frame that is shown; of those that arrive meanwhile, the newest is read next", async () => {
    let frames: Frames<number> = { latest: null, error: "" };
    const waiting: (() => void)[] = [];
    const read = (content: Uint8Array): Promise<number> => new Promise((resolve) => waiting.push(() => resolve(last(content))));
    followFrames(device, "scan", "scan", read, (next) => (frames = next));
    const started = performance.now();
    frame(1);
    await pass(300);
    frame(2);
    await pass(300);
    frame(3);
    await pass(300);
    waiting.shift()?.();
    await pass(0);
    expect([frames.latest?.value, (frames.latest?.at ?? 0) - started]).toEqual([1, 0]);
    waiting.shift()?.();
    await pass(0);
    expect([frames.latest?.value, (frames.latest?.at ?? 0) - started]).toEqual([3, 600]);
  });

  it("keep the newest readable one, with the reason why a later one is not shown", async () => {
    let frames: Frames<number> = { latest: null, error: "" };
    const read = (content: Uint8Array): number => {
      if (last(content) === 2) throw new Error("the scan is damaged");
      return last(content);
    };
    followFrames(device, "scan", "scan", read, (next) => (frames = next));
    frame(1);
    await pass(10);
    frame(2);
    await pass(10);
    expect([frames.latest?.value, frames.error]).toEqual([1, "the scan is damaged"]);
  });

  it("remain current at the quarter of the rate that an agent with a high load sends", async () => {
    let frames: Frames<number> = { latest: null, error: "" };
    followFrames(device, "scan", "scan", last, (next) => (frames = next));
    const current = (): boolean => currentFrame(frames.latest, 2, clock.value) !== null;
    for (const sequence of [1, 2, 3, 4]) {
      frame(sequence);
      await pass(250);
      expect(current()).toBe(true);
      await pass(1_750);
      expect(current()).toBe(true);
    }
    await pass(4_500);
    expect(current()).toBe(true);
    await pass(1_000);
    expect(current()).toBe(false);
  });
});
