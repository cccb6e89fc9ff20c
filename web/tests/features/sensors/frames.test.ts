/** Frames of cameras, depth cameras, lidars and skeleton trackers: decoding and drawing models. */
import { describe, expect, it } from "vitest";
import { coloured, scaleOf } from "../../../src/features/sensors/model/depth-scale";
import { bonesOf, echoesOf, projected } from "../../../src/shared/lib/skeleton";
import { readFrame } from "../../../src/shared/mqtt/camera-frame";
import { MessageError } from "../../../src/shared/mqtt/checks";
import { readDescription } from "../../../src/shared/mqtt/parse-messages";
import { readPeople, readScan, type KnownPerson, type Rotation } from "../../../src/shared/mqtt/sensor-frames";
import { falseColour, MISSING_COLOUR } from "../../../src/shared/ui/colour-map";
import { bytes } from "../../support/messages";

const header = (kind: number, version = 1): number[] => [0x54, 0x53, version, kind, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0x10, 0, 1, 0x40, 0, 0xf0];
const [JPEG, PNG, JSON_TEXT] = [[0xff, 0xd8, 1], [0x89, 0x50, 1], [0x7b, 0x22, 1]];
/** A camera that looks along the room's x axis: right is -y, up is z. */
const FORWARD: Rotation = [[0, 0, -1], [-1, 0, 0], [0, 1, 0]];

describe("a frame", () => {
  it.each([
    [1, "colour", JPEG],
    [2, "depth", PNG],
    [3, "scan", JSON_TEXT],
    [4, "people", JSON_TEXT],
  ] as const)("of the number %i has the kind %s, at any offset of its buffer", (number, kind, content) => {
    const frame = readFrame(Uint8Array.from([9, 9, ...header(number), ...content]).subarray(2), kind);
    expect([frame.kind, frame.sequence, frame.tickMs, frame.width, frame.height]).toEqual([kind, 7, 4096, 320, 240]);
    expect([...frame.content]).toEqual(content);
  });

  it.each([
    ["another version", "colour", [...header(1, 2), ...JPEG]],
    ["an unknown kind", "colour", [...header(5), ...JPEG]],
    ["the kind 0", "colour", [...header(0), ...JPEG]],
    ["another kind than described", "colour", [...header(2), ...PNG]],
    ["no JPEG", "colour", [...header(1), 1, 2, 3]],
    ["a JPEG as depths", "depth", [...header(2), ...JPEG]],
    ["a picture as a scan", "scan", [...header(3), ...PNG]],
    ["no content", "colour", header(1)],
  ] as const)("is rejected with %s", (_, described, payload) => {
    expect(() => readFrame(Uint8Array.from(payload), described)).toThrow(MessageError);
  });
});

describe("the description of a device", () => {
  it("declares the kind of each stream of frames; older agents have cameras only", () => {
    const cameras = [{ name: "view", rate_hz: 5 }, { name: "depth", rate_hz: 5, kind: "depth" }, { name: "heat", rate_hz: 1, kind: "thermal" }];
    const found = readDescription(bytes({ device: "a", kind: "b", robot_type: "c", label: "d", cameras }));
    expect(found.cameras.map(({ kind }) => kind)).toEqual(["colour", "depth", "thermal"]);
  });
});

const scanOf = (more: object): Uint8Array => bytes({ angle_rad: [0, Math.PI / 2, 1], range_m: [1, 2, null], furthest_m: 12, ...more });

describe("a lidar scan", () => {
  it("has one distance, or none, for each beam", () => {
    expect(readScan(scanOf({ at_ms: 1, more: 1 })).range_m).toEqual([1, 2, null]);
    for (const wrong of [{ range_m: [1] }, { rotation: [[1, 0, 0]] }, { position_m: [1, 2] }, { angle_rad: ["a", 1, 2] }]) {
      expect(() => readScan(scanOf(wrong))).toThrow(MessageError);
    }
    expect(() => readScan(new TextEncoder().encode("<html>"))).toThrow("not JSON");
  });

  it("is drawn in the room from the pose of its lidar", () => {
    // Its x axis points along the room's -y, and its y axis along x.
    const turned = readScan(scanOf({ position_m: [0.2, 2.3, 0.3], rotation: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] }));
    const echoes = echoesOf(turned).map((place) => place.map((m) => Math.round(m * 1000) / 1000));
    expect(echoes).toEqual([[0.2, 1.3], [2.2, 2.3]]);
    expect(echoesOf(readScan(scanOf({})))).toEqual([]);
  });
});

const joint = (name: string, y: number, state = "tracked"): object => ({ name, position_m: [3, y, 1], state });
const peopleOf = (people: object[], more: object = {}): Uint8Array =>
  bytes({ position_m: [0, 0, 1], rotation: FORWARD, fovy_rad: Math.PI / 2, people, ...more });

describe("tracked people", () => {
  const person = { id: 4, position_m: [3, 0, 1], joints: [joint("head", 0), joint("shoulder_center", 0.1), joint("spine", 0.2, "inferred"), joint("tail", 1)] };

  it("are rejected with a wrong joint, pose or number", () => {
    expect(readPeople(peopleOf([person])).people[0]?.joints).toHaveLength(4);
    expect(readPeople(peopleOf([{ id: 1, position_m: [1, 2, 3] }])).people[0]?.joints).toEqual([]);
    const wrong = [
      peopleOf([{ ...person, id: -1 }]),
      peopleOf([{ ...person, joints: [joint("head", 0, "measured")] }]),
      peopleOf([{ ...person, joints: [{ name: "head", position_m: [1, 2], state: "tracked" }] }]),
      peopleOf(Array.from({ length: 17 }, () => person)),
      peopleOf([], { fovy_rad: 4 }),
      peopleOf([], { rotation: 1 }),
    ];
    for (const payload of wrong) expect(() => readPeople(payload)).toThrow(MessageError);
  });

  it("have bones between known joints; a bone with an inferred end is not tracked", () => {
    const [found] = readPeople(peopleOf([person])).people as [KnownPerson];
    expect(bonesOf(found).map(({ from, to, tracked }) => [from[1], to[1], tracked])).toEqual([[0, 0.1, true], [0.1, 0.2, false]]);
  });

  it("appear in the picture of their camera where it sees them", () => {
    const people = readPeople(peopleOf([]));
    expect(projected(people, [3, 0, 1], 320, 240)).toEqual([160, 120]);
    // 45 degrees to the left and up are the edges of a field of view of 90 degrees.
    const edge = projected(people, [2, 2, 3], 320, 240) ?? [0, 0];
    expect(edge[0]).toBeCloseTo(40);
    expect(edge[1]).toBeCloseTo(0);
    expect(projected(people, [-1, 0, 1], 320, 240)).toBeNull();
  });
});

describe("the colours of a depth image", () => {
  const image = (...depths: number[]) => ({ width: depths.length, height: 1, depthM: Float32Array.from(depths) });

  it("cover its distances and leave out missing echoes", () => {
    const scale = scaleOf(image(0, 1.04, 2.51), null);
    expect(scale).toEqual({ nearM: 1, farM: 2.6 });
    const pixels = [...coloured(image(0, 1, 2.6), { nearM: 1, farM: 2.6 })];
    expect(pixels).toEqual([...MISSING_COLOUR, 255, ...falseColour(0), 255, ...falseColour(1), 255]);
    expect(scaleOf(image(0, 0), null)).toBeNull();
  });

  it("keep a live scale until the view has changed", () => {
    const first = { nearM: 1, farM: 4 };
    expect(scaleOf(image(1.5, 3.2), first)).toEqual(first);
    expect(scaleOf(image(0.82, 5.01), first)).toEqual({ nearM: 0.8, farM: 5.1 });
    expect(scaleOf(image(1.2, 1.7), first)).toEqual({ nearM: 1.2, farM: 1.8 });
    expect(scaleOf(image(0), first)).toEqual(first);
  });
});
