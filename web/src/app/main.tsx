import { effect } from "@preact/signals";
import { render } from "preact";
import { Api } from "../shared/api/client";
import { storage } from "../shared/hooks/browser-storage";
import { startClock } from "../shared/lib/clock";
import { FollowedInvitation, invitationSecret } from "../features/sharing/model/invitation-link";
import { FollowedCode, pairingCode } from "../features/pairing/model/claim-code";
import { KnownBrowser } from "../features/account/model/known-browser";
import { Session, signInFailure, signInToken } from "../features/account/model/session";
import "../shared/ui/styles/tokens.css";
import "../shared/ui/styles/base.css";
import "../shared/ui/styles/controls.css";
import "../shared/ui/styles/layout.css";
import "../shared/ui/styles/sliders.css";
import "../shared/ui/styles/charts.css";
import "../shared/ui/styles/lists.css";
import "../shared/ui/styles/forms.css";
import { texts } from "./texts";
import { App, preloadPages } from "./app";
import { invitationAddress, pairAddress, replaceWith } from "../shared/routing/routes";

const api = new Api();
const session = new Session(api, new KnownBrowser(storage()));
const followed = new FollowedInvitation(sessionStorage);
const pairing = new FollowedCode(sessionStorage);

/** Removes a sign-in token from the address before other code can read, show or store it. */
function takeToken(): string | null {
  const token = signInToken(location.hash);
  if (token !== null) history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  return token;
}

/** Removes an invitation's secret from the address, like a sign-in token. */
function takeInvitation(): void {
  const secret = invitationSecret(location.hash);
  if (secret === null) return;
  history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  followed.follow(secret);
}

/** Removes a claim code from the address, like a sign-in token. */
function takeCode(): void {
  const code = pairingCode(location.hash);
  if (!location.hash.startsWith("#pair=")) return;
  history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  if (code !== null) pairing.follow(code);
}

/** Removes an external sign-in error from the address, so that it is shown once. */
function takeFailure(): string {
  const code = signInFailure(location.hash);
  if (code === null) return "";
  history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  if (code === "oidc-expired") return texts.openIdExpired;
  return code === "oidc-uninvited" ? texts.openIdUninvited : texts.openIdRefused;
}

takeInvitation();
takeCode();
// After the sign-in, return the user to the invitation.
effect(() => {
  if (session.state.value.kind === "in" && followed.state.value.kind === "open") replaceWith(invitationAddress);
});
effect(() => {
  if (session.state.value.kind === "in" && pairing.code.value !== null) replaceWith(pairAddress);
});
preloadPages();
startClock();
void session.start(takeToken(), takeFailure());
addEventListener("hashchange", () => {
  takeInvitation();
  takeCode();
  const token = takeToken();
  if (token !== null) void session.start(token);
});

const root = document.getElementById("app");
if (root !== null) render(<App api={api} session={session} followed={followed} pairing={pairing} />, root);
