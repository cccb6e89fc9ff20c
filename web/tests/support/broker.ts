/** An MQTT broker over WebSocket on this machine. Each connection needs its own credentials. */
import { randomUUID } from "node:crypto";
import { createServer } from "node:http";
import type { AddressInfo } from "node:net";
import { Aedes, type Client } from "aedes";
import { createWebSocketStream, WebSocketServer } from "ws";
import type { Credentials } from "../../src/shared/api/types";

export class Broker {
  readonly #server = createServer();
  readonly #sockets = new WebSocketServer({ noServer: true });
  readonly #passwords = new Map<string, string>();
  readonly #clients = new Set<Client>();
  #broker: Aedes | null = null;
  #publisher: ReturnType<typeof setInterval> | undefined;
  #sequence = 0;
  /** Refuses connections. */
  down = false;
  /** How many credentials it has issued. */
  issued = 0;
  lifetimeS = 900;
  /** The number of filters of each SUBSCRIBE. */
  readonly subscribes: number[] = [];
  /** The topics that clients published to. */
  readonly published: string[] = [];

  async start(): Promise<void> {
    const broker = await Aedes.createBroker({
      authenticate: ({ id }, _, password, done) => done(null, this.#passwords.get(id) === password?.toString()),
    });
    broker.on("publish", ({ topic }, client) => client !== null && this.published.push(topic));
    broker.on("subscribe", (subscriptions) => this.subscribes.push(subscriptions.length));
    broker.on("client", (client) => this.#clients.add(client));
    broker.on("clientDisconnect", (client) => this.#clients.delete(client));
    this.#server.on("upgrade", (request, socket, head) => {
      if (this.down) {
        socket.destroy();
        return;
      }
      this.#sockets.handleUpgrade(request, socket, head, (webSocket) => {
        const stream = createWebSocketStream(webSocket);
        stream.on("error", () => undefined);
        broker.handle(stream, request);
      });
    });
    await new Promise<void>((resolve) => this.#server.listen(0, "127.0.0.1", resolve));
    this.#broker = broker;
  }

  async stop(): Promise<void> {
    clearInterval(this.#publisher);
    this.cutAll();
    await new Promise<void>((resolve) => this.#broker?.close(resolve));
    for (const socket of this.#sockets.clients) socket.terminate();
    await new Promise((resolve) => this.#server.close(resolve));
  }

  readonly credentials = (): Promise<Credentials> => {
    this.issued += 1;
    const [id, password] = [randomUUID(), randomUUID()];
    this.#passwords.set(id, password);
    const websocket_url = `ws://127.0.0.1:${(this.#server.address() as AddressInfo).port}/mqtt`;
    return Promise.resolve({ client_id: id, username: "demo", password, lifetime_s: this.lifetimeS, publish: [], subscribe: [], websocket_url });
  };

  get clientIds(): string[] {
    return [...this.#clients].map(({ id }) => id);
  }

  cutAll(): void {
    for (const client of this.#clients) client.close();
  }

  publish(topic: string, message: object, retain = false): void {
    this.#broker?.publish({ cmd: "publish", topic, payload: JSON.stringify(message), qos: 0, retain, dup: false }, () => undefined);
  }

  /** Publishes messages with rising `sequence` every 20 ms until the end of the test. */
  stream(topic: string): void {
    this.#publisher = setInterval(() => this.publish(topic, { sequence: (this.#sequence += 1) }), 20);
  }
}
