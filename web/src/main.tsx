import { render } from "preact";
import { Api } from "./core/api";
import { startClock } from "./core/clock";
import { Session, signInFailure, signInToken } from "./core/session";
import { App } from "./ui/app";
import "./style.css";
import { texts } from "./texts";

const api = new Api();
const session = new Session(api);

/** Take a sign-in token out of the address before anything else can read, show or keep it. */
function takeToken(): string | null {
  const token = signInToken(location.hash);
  if (token !== null) history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  return token;
}

/** What went wrong elsewhere, taken out of the address: it is said once. */
function takeFailure(): string {
  const code = signInFailure(location.hash);
  if (code === null) return "";
  history.replaceState(null, "", `${location.pathname}${location.search}#/`);
  return code === "open-id-expired" ? texts.session.elsewhereExpired : texts.session.elsewhereRefused;
}

startClock();
void session.start(takeToken(), takeFailure());
addEventListener("hashchange", () => {
  const token = takeToken();
  if (token !== null) void session.start(token);
});

const root = document.getElementById("app");
if (root !== null) render(<App api={api} session={session} />, root);
