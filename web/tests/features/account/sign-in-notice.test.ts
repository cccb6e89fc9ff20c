import { expect, it } from "vitest";
import { browserName, ConfirmedSignIns } from "../../../src/features/account/model/sign-in-notice";
import type { PastSignIn } from "../../../src/shared/api/account";
import { FakeStorage } from "../../support/fake-storage";

const signIn = (minute: number, more: Partial<PastSignIn> = {}): PastSignIn => ({
  session: `s${minute}`,
  method: "password",
  at: `2026-01-31T12:0${minute}:00.000Z`,
  address: "192.0.2.1",
  program: "Mozilla",
  known_browser: false,
  mine: false,
  ...more,
});

it("reports later sign-ins of unknown browsers until the user of this browser confirms them", () => {
  const browser = new FakeStorage();
  const confirmed = new ConfirmedSignIns(browser, "demo");
  const first = [signIn(2, { mine: true }), signIn(1)];
  expect(confirmed.unconfirmed(first)).toEqual([]);
  const later = [signIn(4), signIn(3, { known_browser: true }), ...first];
  expect(confirmed.unconfirmed(later).map(({ session }) => session)).toEqual(["s4"]);
  confirmed.confirm(confirmed.unconfirmed(later));
  expect(confirmed.unconfirmed(later)).toEqual([]);
  expect(new ConfirmedSignIns(browser, "demo").unconfirmed([signIn(5), ...later])).toHaveLength(1);
  expect(new ConfirmedSignIns(browser, "other").unconfirmed(later)).toHaveLength(1);
});

it.each([
  ["Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/140.0 Safari/537.36", "Chrome, Linux"],
  ["Mozilla/5.0 (Windows NT 10.0; Win64; x64) AppleWebKit/537.36 Chrome/140.0 Safari/537.36 Edg/140.0", "Edge, Windows"],
  ["Mozilla/5.0 (iPhone; CPU iPhone OS 18_0 like Mac OS X) AppleWebKit/605 Version/18.0 Mobile Safari/604.1", "Safari, iPhone"],
  ["python-httpx/0.28.1", "python-httpx/0.28.1"],
  ["", ""],
])("names the browser of a user agent: %s", (userAgent, name) => {
  expect(browserName(userAgent)).toBe(name);
});
