import { describe, expect, it, vi } from "vitest";
import type { PageName } from "../../src/shared/routing/routes";

vi.stubGlobal("location", { hash: "" });
vi.stubGlobal("addEventListener", () => undefined);
const { ROWS } = await import("../../src/app/page-registry");
const route = await import("../../src/shared/routing/routes");

describe("the table of pages", () => {
  it("maps the address of each page to that page", () => {
    const addresses = {
      devices: route.deviceListAddress,
      device: route.deviceAddress("a-b"),
      keyframes: route.keyframesAddress("a-b", "wave"),
      typeKeyframes: route.typeKeyframesAddress("ur5"),
      multiRobot: route.multiRobotAddress(["a-b", "c_d"]),
      space: route.spaceAddress("lab"),
      pair: route.pairAddress,
      movements: route.movementsAddress,
      movement: route.movementAddress("ur5", "wave"),
      robotTypes: route.robotTypesAddress,
      robotType: route.robotTypeAddress("ur5"),
      addRobotType: route.addRobotTypeAddress,
      health: route.healthAddress,
      deviceHealth: route.healthAddressOf("device", "a-b"),
      spaceHealth: route.healthAddressOf("space", "lab"),
      latency: route.pageAddress("latency"),
      deviceLatency: route.latencyAddressOf("a-b"),
      deviceAutonomy: route.autonomyAddressOf("a-b"),
      timeline: route.pageAddress("timeline"),
      session: route.sessionAddress("a-b", 7),
      tasks: route.tasksAddress("ur5_gripper"),
      task: route.taskAddress("ur5_gripper", "red_cube"),
      account: route.accountAddress,
      auditLog: route.auditLogAddress,
      administration: route.pageAddress("administration"),
      invitation: route.invitationAddress,
    } satisfies Record<PageName, string>;
    for (const [page, address] of Object.entries(addresses)) expect(route.read(address).page, address).toBe(page);
  });

  it("reads the parameters of an address; an unknown address is the device list", () => {
    expect(route.read("#/devices/a-b/keyframes/wave").at).toMatchObject({ id: "a-b", name: "wave", robotType: "" });
    expect(route.read("#/devices/a-b/keyframes")).toMatchObject({ page: "keyframes", at: { id: "a-b", name: "" } });
    expect(route.read("#/operate/a-b,c_d").at.ids).toBe("a-b,c_d");
    for (const hash of ["", "#", "#/nowhere", "#/devices/", "#/devices/a/b/c", "#/devices/<b>"]) expect(route.read(hash).page, hash).toBe("devices");
  });

  it("has one navigation link for each section except the account", () => {
    const linked = [...ROWS.values()].filter(({ link }) => link !== undefined).map(({ part }) => part);
    const parts = new Set([...ROWS.values()].map(({ part }) => part).filter((part) => part !== "account"));
    expect(linked.sort()).toEqual([...parts].sort());
  });
});
