import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { XmppLink } from "../../src/shared/xmpp/xmpp-link";
import { XmppServer } from "../support/xmpp-server";

const TOPIC = "ts/v1/lab/a1/arm/ctl/7";
const CLOUD = "cloud@telescope.localhost/g1";

const until = (condition: () => boolean, timeout = 15_000): Promise<boolean> => vi.waitUntil(condition, { timeout, interval: 5 });

let server: XmppServer;
let links: XmppLink[];

beforeEach(async () => {
  links = [];
  server = new XmppServer();
  await server.start();
});

afterEach(async () => {
  vi.useRealTimers();
  for (const link of links) link.close();
  await server.stop();
});

function open(replaceAfterMs?: number): XmppLink {
  const link = new XmppLink(server.credentials, replaceAfterMs);
  links.push(link);
  return link;
}

async function opened(): Promise<XmppLink> {
  const link = open();
  await until(() => link.status.value.state === "up");
  return link;
}

describe("the connection over XMPP", () => {
  it("delivers the payload exactly, because the robot verifies its bytes", async () => {
    const link = await opened();
    const message = { text: `<&>'"é`, values: [0.1, -1e-7] };
    await link.publish(TOPIC, message);
    await until(() => server.messages.length === 1);
    expect(server.messages).toEqual([{ topic: TOPIC, payload: JSON.stringify(message) }]);
  });

  it("renews its token on the same stream", async () => {
    server.lifetimeS = 1.5;
    await opened();
    const streams = server.clientIds;
    await until(() => server.signIns.length >= 3);
    expect(server.clientIds).toEqual(streams);
  });

  it("replaces an old stream before the server ends it", async () => {
    server.lifetimeS = 1.5;
    const link = open(0);
    await until(() => link.status.value.state === "up");
    const streams = server.clientIds;
    await until(() => server.signIns.length >= 2 && server.clientIds.length === 1);
    expect(server.clientIds).not.toEqual(streams);
    expect(link.status.value.state).toBe("up");
  });

  it("is down while no gateway is online, and uses the next one", async () => {
    const link = await opened();
    server.leave();
    await until(() => link.status.value.state === "down");
    expect(link.status.value.reason).toBe("The XMPP gateway was disconnected.");
    await expect(link.publish(TOPIC, {})).rejects.toThrow("There is no connection");
    server.gateway = "g2";
    await until(() => link.status.value.state === "up");
  });

  it("is down when the gateway rejects a setpoint", async () => {
    const link = await opened();
    server.down = true;
    server.reject("You do not have control.");
    await until(() => link.status.value.state === "down");
    expect(server.issued).toBe(1);
    expect(link.status.value.reason).toBe("You do not have control.");
  });

  it("ignores stanzas of other users and messages of topics", async () => {
    const link = await opened();
    server.sendAs("mallory@telescope.localhost/x", "<error/>", "type='error'");
    server.sendAs(`${CLOUD}2`, "<error/>", "type='error'");
    server.sendAs(CLOUD, `<m xmlns='urn:telescope:v1' topic='ts/v1/lab/a1/arm/state'>{}</m>`);
    await link.publish(TOPIC, {});
    await until(() => server.messages.length === 1);
    expect(link.status.value.state).toBe("up");
  });

  it("reports a rejected sign-in and tries again with new credentials", async () => {
    server.signInStatus = 403;
    const link = open();
    await until(() => link.status.value.state === "down");
    expect(link.status.value.reason).toBe("The XMPP gateway rejected the sign-in: Sign in again.");
    server.signInStatus = 204;
    await until(() => link.status.value.state === "up");
  });

  it("reports rejected XMPP credentials", async () => {
    const link = new XmppLink(async () => ({ ...(await server.credentials()), password: "wrong" }));
    links.push(link);
    await until(() => link.status.value.state === "down");
    expect(link.status.value.reason).toBe("The XMPP server rejected the credentials.");
  });

  it("detects a server that answers no more", async () => {
    const link = await opened();
    server.silent = true;
    await until(() => link.status.value.state === "down");
    expect(link.status.value.reason).toBe("The XMPP server does not respond.");
  });

  it("gives up on a server without a gateway", async () => {
    server.gateway = "";
    const link = open();
    await until(() => link.status.value.state === "down");
    expect(link.status.value.reason).toBe("The XMPP server or its gateway did not respond.");
  });
});
