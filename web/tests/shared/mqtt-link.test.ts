import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { ApiError } from "../../src/shared/api/http";
import type { Credentials } from "../../src/shared/api/types";
import { MqttLink, type LinkState } from "../../src/shared/mqtt/mqtt-link";
import { Broker } from "../support/broker";

const STATE = "ts/v1/lab/a1/arm/state";
const STREAM = "ts/v1/lab/a1/arm/tele/joints";
const FILTER = "ts/v1/lab/a1/arm/tele/+";
const STOP = "ts/v1/lab/a1/arm/stop";

const until = (condition: () => boolean): Promise<boolean> => vi.waitUntil(condition, { timeout: 15_000, interval: 5 });

let broker: Broker;
let links: MqttLink[];

beforeEach(async () => {
  links = [];
  broker = new Broker();
  await broker.start();
  broker.publish(STATE, {}, true);
  broker.stream(STREAM);
});

afterEach(async () => {
  for (const link of links) link.close();
  await broker.stop();
});

function open(credentials: () => Promise<Credentials> = broker.credentials): MqttLink {
  const link = new MqttLink(credentials);
  links.push(link);
  return link;
}

describe("the link to the broker", () => {
  it("receives retained and live messages, in subscriptions of at most eight filters", async () => {
    const link = open();
    const received = new Map<string, boolean>();
    const others = Array.from({ length: 18 }, (_, index) => `ts/v1/lab/a2/d${index}/state`);
    for (const filter of [STATE, FILTER, ...others]) link.subscribe(filter, (topic, _, retained) => received.set(topic, retained));
    await until(() => received.size === 2 && broker.subscribes.length === 3);
    expect([received.get(STATE), received.get(STREAM)]).toEqual([true, false]);
    expect(broker.subscribes).toEqual([8, 8, 4]);
  });

  it("resolves each ping with its own response, and rejects it without a connection", async () => {
    const link = open();
    await until(() => link.up.value);
    const order: number[] = [];
    await Promise.all([1, 2, 3].map((number) => link.ping().then(() => order.push(number))));
    expect(order).toEqual([1, 2, 3]);
    const lost = link.ping();
    link.close();
    await expect(lost).rejects.toThrow("The broker did not respond.");
    await expect(link.ping()).rejects.toThrow("There is no connection");
  });

  it("reconnects with new credentials after a connection loss, also if the broker is unavailable at first", async () => {
    const link = open();
    let count = 0;
    link.subscribe(FILTER, () => (count += 1));
    await until(() => count > 0);
    const [first] = broker.clientIds;
    broker.down = true;
    broker.cutAll();
    await until(() => link.status.value.state === "down" && broker.issued > 1);
    expect(link.status.value.reason).not.toBe("");
    broker.down = false;
    count = 0;
    await until(() => link.up.value && count > 0);
    expect(broker.clientIds).not.toContain(first);
  });

  it("replaces credentials before they expire, without losing messages", async () => {
    broker.lifetimeS = 1.5;
    const link = open();
    const states = new Set<LinkState>();
    const received = new Set<number>();
    link.subscribe(FILTER, (_, payload) => received.add((JSON.parse(new TextDecoder().decode(payload)) as { sequence: number }).sequence));
    await until(() => link.up.value);
    link.status.subscribe((status) => states.add(status.state));
    await until(() => broker.issued >= 3);
    await until(() => broker.clientIds.length === 1);
    expect([...states]).toEqual(["up"]);
    expect(received.size - 1).toBe(Math.max(...received) - Math.min(...received));
  });

  it("publishes immediately or not at all", async () => {
    const link = open();
    await expect(link.publish(STOP, {}, 1)).rejects.toThrow(/no connection/);
    await until(() => link.up.value);
    await link.publish(STOP, {}, 1);
    expect(broker.published).toEqual([STOP]);
  });

  it("stays closed after the server rejects the credentials request, until it is renewed", async () => {
    let signedOut = true;
    const link = open(() => (signedOut ? Promise.reject(new ApiError(401, "signed-out", "You are not signed in.")) : broker.credentials()));
    await until(() => link.status.value.state === "refused");
    expect(link.status.value.reason).toBe("You are not signed in.");
    signedOut = false;
    link.renew();
    await until(() => link.up.value);
  });

  it("delivers nothing after unsubscribing or closing", async () => {
    const link = open();
    let [ended, continued] = [0, 0];
    const end = link.subscribe(STREAM, () => (ended += 1));
    link.subscribe(FILTER, () => (continued += 1));
    await until(() => ended > 2);
    end();
    const before = [ended, continued];
    await until(() => continued > (before[1] ?? 0) + 5);
    expect(ended).toBe(before[0]);
    link.close();
    await until(() => broker.clientIds.length === 0);
  });
});
