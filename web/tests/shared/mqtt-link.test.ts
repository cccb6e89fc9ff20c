import { afterEach, beforeEach, describe, expect, it } from "vitest";
import { Api } from "../../src/shared/api/client";
import { MqttLink, type LinkState } from "../../src/shared/mqtt/mqtt-link";
import { Cloud, problem } from "../support/cloud";
import { until } from "../support/until";

const TOPIC = "ts/v1/lab/agent00001/arm";
const CONN = "ts/v1/lab/agent00001/conn";

let cloud: Cloud;
let api: Api;
const links: MqttLink[] = [];

function open(): MqttLink {
  const link = new MqttLink(() => api.credentials({ purpose: "view" }));
  links.push(link);
  return link;
}

async function start(options: ConstructorParameters<typeof Cloud>[0] = {}): Promise<void> {
  cloud = new Cloud(options);
  await cloud.start();
  api = new Api(`${cloud.address}/api/v1`);
  await api.me();
}

beforeEach(() => {
  links.length = 0;
});

afterEach(async () => {
  for (const link of links) link.close();
  await cloud.stop();
});

describe("the link to the broker", () => {
  it("hears retained and live messages, in subscriptions of at most eight filters", async () => {
    const others = Array.from({ length: 20 }, (_, index) => `ts/v1/lab/other/d${index}/state`);
    await start({ audible: others });
    const link = open();
    const heard = new Map<string, boolean>();
    const filters = [CONN, ...["desc", "desc/twin", "state", "tele/+", "event", "ack", "cam/+"].map((kind) => `${TOPIC}/${kind}`)];
    for (const filter of [...filters, ...others]) link.subscribe(filter, (topic, _, retained) => heard.set(topic, retained));
    await until(() => heard.has(`${TOPIC}/tele/joints`) && heard.has(`${TOPIC}/desc/twin`), "messages");
    expect(heard.get(`${TOPIC}/desc`)).toBe(true);
    expect(heard.get(`${TOPIC}/tele/joints`)).toBe(false);
    expect(cloud.subscribes).toEqual([8, 8, 8, 4]);
  });

  it("pings the broker and hears its answer, each its own, and fails without a connection", async () => {
    await start();
    const link = open();
    await until(() => link.up.value, "the link");
    const order: number[] = [];
    await Promise.all([1, 2, 3].map((number) => link.ping().then(() => order.push(number))));
    expect(order).toEqual([1, 2, 3]);
    const lost = link.ping();
    link.close();
    await expect(lost).rejects.toThrow("The broker did not answer.");
    await expect(link.ping()).rejects.toThrow("There is no connection");
  });

  it("comes back with new credentials after the connection was cut", async () => {
    await start();
    const link = open();
    let count = 0;
    link.subscribe(`${TOPIC}/tele/+`, () => (count += 1));
    await until(() => count > 0, "telemetry");
    const [first] = cloud.clientIds;
    cloud.cutAll();
    await until(() => !link.up.value, "the loss");
    count = 0;
    await until(() => link.up.value && count > 0, "telemetry again");
    expect(cloud.clientIds).not.toContain(first);
    expect(cloud.callsTo("POST", "/mqtt/credentials")).toHaveLength(2);
  });

  it("keeps trying while the broker is away", async () => {
    await start();
    cloud.brokerDown = true;
    const link = open();
    await until(() => link.status.value.state === "down", "the failure");
    expect(link.status.value.why).not.toBe("");
    cloud.brokerDown = false;
    await until(() => link.up.value, "the connection");
  });

  it("moves to new credentials before the old ones run out, without a gap", async () => {
    await start({ lifetimeS: 1.5 });
    const link = open();
    const states = new Set<LinkState>();
    const ticks: number[] = [];
    link.subscribe(`${TOPIC}/tele/+`, (_, payload) => {
      ticks.push((JSON.parse(new TextDecoder().decode(payload)) as { sequence: number }).sequence);
    });
    await until(() => link.up.value, "the connection");
    link.status.subscribe((status) => states.add(status.state));
    await until(() => cloud.callsTo("POST", "/mqtt/credentials").length >= 3, "two renewals");
    await until(() => cloud.connections === 1, "the old connection's end");
    expect([...states]).toEqual(["up"]);
    const seen = [...new Set(ticks)].sort((a, b) => a - b);
    expect(seen.length - 1).toBe((seen.at(-1) ?? 0) - (seen[0] ?? 0));
  });

  it("publishes at once or not at all", async () => {
    await start();
    const link = open();
    await expect(link.publish(`${TOPIC}/stop`, { id: "s", caller: "me" }, 1)).rejects.toThrow(/no connection/);
    await until(() => link.up.value, "the connection");
    await link.publish(`${TOPIC}/stop`, { id: "s", caller: "me" }, 1);
    expect(cloud.arm?.stops).toBe(1);
  });

  it("stops asking when the server refuses credentials, and says why", async () => {
    await start();
    cloud.instead.set("POST /mqtt/credentials", () => problem(401, "signed-out", "You are not signed in."));
    const link = open();
    await until(() => link.status.value.state === "refused", "the refusal");
    expect(link.status.value.why).toBe("You are not signed in.");
    cloud.instead.clear();
    link.renew();
    await until(() => link.up.value, "the connection");
  });

  it("hears nothing any more once unsubscribed or closed", async () => {
    await start();
    const link = open();
    let count = 0;
    const end = link.subscribe(`${TOPIC}/tele/+`, () => (count += 1));
    await until(() => count > 2, "telemetry");
    end();
    const after = count;
    await new Promise((resolve) => setTimeout(resolve, 200));
    expect(count).toBe(after);
    link.close();
    await until(() => cloud.connections === 0, "the end of the connection");
  });
});
