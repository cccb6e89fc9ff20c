/** Where the page is: in the address's fragment, which the server never sees. */
import { signal, type ReadonlySignal } from "@preact/signals";

export type Route = { page: "fleet" } | { page: "account" } | { page: "device"; id: string };

export const accountAddress = "#/account";

function read(): Route {
  if (location.hash === accountAddress) return { page: "account" };
  const found = /^#\/devices\/([A-Za-z0-9_-]+)$/.exec(location.hash);
  return found?.[1] === undefined ? { page: "fleet" } : { page: "device", id: found[1] };
}

const current = signal(read());
export const route: ReadonlySignal<Route> = current;

export const fleetAddress = "#/";

export function deviceAddress(id: string): string {
  return `#/devices/${id}`;
}

addEventListener("hashchange", () => (current.value = read()));
