/** An XMPP server over WebSocket on this machine, with one gateway. Each stream needs its own credentials. */
import { randomUUID } from "node:crypto";
import { createServer } from "node:http";
import type { AddressInfo } from "node:net";
import { DOMParser, type Element } from "@xmldom/xmldom";
import { WebSocketServer, type WebSocket } from "ws";
import type { XmppCredentials } from "../../src/shared/api/types";

const DOMAIN = "telescope.localhost";
const USER = "account0001";
const FRAMING = "urn:ietf:params:xml:ns:xmpp-framing";
const SASL = "urn:ietf:params:xml:ns:xmpp-sasl";
const BIND = "urn:ietf:params:xml:ns:xmpp-bind";
const OURS = "urn:telescope:v1";

interface Client {
  socket: WebSocket;
  loggedIn: boolean;
  jid: string;
}

export class XmppServer {
  readonly #server = createServer();
  readonly #sockets = new WebSocketServer({ noServer: true, handleProtocols: () => "xmpp" });
  readonly #passwords = new Set<string>();
  readonly #tokens = new Set<string>();
  readonly #clients = new Set<Client>();
  /** Refuses connections. */
  down = false;
  /** Answers nothing more. */
  silent = false;
  /** Resource of the gateway; empty: none is online. */
  gateway = "g1";
  /** How many credentials it has issued. */
  issued = 0;
  lifetimeS = 900;
  /** Topics and payloads of setpoints. */
  readonly messages: { topic: string; payload: string }[] = [];
  /** Status of each answer to a sign-in. */
  readonly signIns: number[] = [];
  /** Status with which the gateway answers each sign-in. */
  signInStatus = 204;

  async start(): Promise<void> {
    this.#server.on("upgrade", (request, socket, head) => {
      if (this.down) {
        socket.destroy();
        return;
      }
      this.#sockets.handleUpgrade(request, socket, head, (webSocket) => {
        const client: Client = { socket: webSocket, loggedIn: false, jid: "" };
        this.#clients.add(client);
        webSocket.on("close", () => this.#clients.delete(client));
        webSocket.on("message", (data: Buffer) => {
          const element = new DOMParser().parseFromString(data.toString(), "text/xml").documentElement;
          if (element !== null && !this.silent) this.#receive(client, element);
        });
      });
    });
    await new Promise<void>((resolve) => this.#server.listen(0, "127.0.0.1", resolve));
  }

  async stop(): Promise<void> {
    this.cutAll();
    await new Promise((resolve) => this.#server.close(resolve));
  }

  readonly credentials = (): Promise<XmppCredentials> => {
    this.issued += 1;
    const [password, token] = [randomUUID(), randomUUID()];
    this.#passwords.add(password);
    this.#tokens.add(token);
    const websocket_url = `ws://127.0.0.1:${(this.#server.address() as AddressInfo).port}/xmpp-websocket`;
    const jid = `${USER}@${DOMAIN}`;
    return Promise.resolve({ jid, password, token, lifetime_s: this.lifetimeS, cloud: `cloud@${DOMAIN}`, websocket_url });
  };

  get published(): string[] {
    return this.messages.map(({ topic }) => topic);
  }

  /** JIDs of the open streams. */
  get clientIds(): string[] {
    return [...this.#clients].map(({ jid }) => jid);
  }

  cutAll(): void {
    for (const { socket } of this.#clients) socket.terminate();
  }

  /** The gateway disconnects. */
  leave(): void {
    this.#sendAll((to) => `<presence xmlns='jabber:client' type='unavailable' from='${this.#cloud}' to='${to}'/>`);
    this.gateway = "";
  }

  /** The gateway rejects a setpoint. */
  reject(reason: string): void {
    const error = `<error type='modify'><text xmlns='urn:ietf:params:xml:ns:xmpp-stanzas'>${reason}</text></error>`;
    this.#sendAll((to) => `<message xmlns='jabber:client' type='error' id='ctl' from='${this.#cloud}' to='${to}'>${error}</message>`);
  }

  /** A stanza of another user. */
  sendAs(from: string, content: string, attributes = ""): void {
    this.#sendAll((to) => `<message xmlns='jabber:client' ${attributes} from='${from}' to='${to}'>${content}</message>`);
  }

  get #cloud(): string {
    return `cloud@${DOMAIN}/${this.gateway}`;
  }

  #sendAll(stanza: (to: string) => string): void {
    for (const { socket, jid } of this.#clients) socket.send(stanza(jid));
  }

  #receive(client: Client, element: Element): void {
    const { socket } = client;
    const id = element.getAttribute("id") ?? "";
    const name: string = element.localName ?? "";
    switch (name) {
      case "open":
        socket.send(`<open xmlns='${FRAMING}' from='${DOMAIN}' id='${randomUUID()}' version='1.0'/>`);
        socket.send(
          `<stream:features xmlns:stream='http://etherx.jabber.org/streams' xmlns='jabber:client'>${
            client.loggedIn ? `<bind xmlns='${BIND}'/>` : `<mechanisms xmlns='${SASL}'><mechanism>PLAIN</mechanism></mechanisms>`
          }</stream:features>`,
        );
        return;
      case "auth": {
        const [, user, password] = Buffer.from(element.textContent ?? "", "base64").toString().split("\0");
        // Each password is for one stream.
        client.loggedIn = user === USER && this.#passwords.delete(password ?? "");
        socket.send(client.loggedIn ? `<success xmlns='${SASL}'/>` : `<failure xmlns='${SASL}'><not-authorized/></failure>`);
        return;
      }
      case "iq": {
        if (element.getElementsByTagName("bind").length > 0) client.jid = `${USER}@${DOMAIN}/${randomUUID()}`;
        const bound = `<bind xmlns='${BIND}'><jid>${client.jid}</jid></bind>`;
        const pinged = element.getElementsByTagName("ping").length > 0;
        socket.send(`<iq xmlns='jabber:client' type='result' id='${id}' from='${DOMAIN}'>${pinged ? "" : bound}</iq>`);
        return;
      }
      case "presence":
        if (this.gateway !== "") socket.send(`<presence xmlns='jabber:client' from='${this.#cloud}' to='${client.jid}'/>`);
        return;
      case "message":
        this.#message(client, id, element);
        return;
      case "close":
        socket.send(`<close xmlns='${FRAMING}'/>`);
        socket.close();
        return;
      default:
        throw new Error(`unexpected <${name}>`);
    }
  }

  #message({ socket, jid }: Client, id: string, element: Element): void {
    const [signIn] = element.getElementsByTagNameNS(OURS, "sign-in");
    if (signIn !== undefined) {
      // As at the gateway.
      if (!/^[A-Za-z0-9_.-]{1,64}$/.test(id)) {
        this.reject("a request needs an id");
        return;
      }
      const status = this.#tokens.delete(signIn.getAttribute("token") ?? "") ? this.signInStatus : 401;
      this.signIns.push(status);
      const problem = status < 400 ? "" : JSON.stringify({ detail: "Sign in again." });
      const answer = `<answer xmlns='${OURS}' status='${status}'>${problem}</answer>`;
      socket.send(`<message xmlns='jabber:client' id='${id}' from='${this.#cloud}' to='${jid}'>${answer}</message>`);
    }
    const [setpoint] = element.getElementsByTagNameNS(OURS, "m");
    if (setpoint === undefined) return;
    this.messages.push({ topic: setpoint.getAttribute("topic") ?? "", payload: setpoint.textContent ?? "" });
  }
}
