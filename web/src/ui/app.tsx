import { effect, useSignalEffect } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { ApiError, type Account, type Api } from "../core/api";
import { Fleet } from "../core/fleet";
import type { Session } from "../core/session";
import { texts } from "../texts";
import { AccountPage } from "./account-page";
import { DevicePage } from "./device-page";
import { FleetPage } from "./fleet-page";
import { accountAddress, fleetAddress, route } from "./route";
import { SignIn } from "./sign-in";

interface AppProps {
  api: Api;
  session: Session;
}

export function App({ api, session }: AppProps) {
  const state = session.state.value;
  switch (state.kind) {
    case "checking":
      return (
        <main class="narrow" id="content">
          <p class="quiet" role="status">
            {texts.session.checking}
          </p>
        </main>
      );
    case "out":
      return <SignIn api={api} session={session} why={state.why} />;
    case "in":
      return <SignedIn key={state.account.session} api={api} session={session} account={state.account} />;
  }
}

interface SignedInProps extends AppProps {
  account: Account;
}

function SignedIn({ api, session, account }: SignedInProps) {
  const [fleet, setFleet] = useState<Fleet | null>(null);
  useEffect(() => {
    const made = new Fleet(api);
    setFleet(made);
    const forget = effect(() => {
      // Refused credentials mean, nearly always, that the sign-in has ended: the server knows.
      if (made.link.status.value.state === "refused") void checkSession(api, session);
    });
    return () => {
      forget();
      made.dispose();
    };
  }, [api, session]);
  if (fleet === null) return null;
  const at = route.value;
  return (
    <>
      <a class="skip" href="#content" onClick={focusContent}>
        {texts.skipToContent}
      </a>
      <header class="top">
        <a class="brand" href={fleetAddress}>
          {texts.product}
        </a>
        <a class="account" data-testid="signed-in" href={accountAddress} title={texts.session.signedInAs(account.name)}>
          {account.name}
        </a>
        <button type="button" class="plain" onClick={() => void session.signOut()}>
          {texts.session.out}
        </button>
      </header>
      <LinkBanner fleet={fleet} />
      {at.page === "fleet" && <FleetPage fleet={fleet} />}
      {at.page === "account" && <AccountPage api={api} />}
      {at.page === "device" && <DevicePage key={at.id} api={api} fleet={fleet} id={at.id} account={account} />}
    </>
  );
}

async function checkSession(api: Api, session: Session): Promise<void> {
  try {
    await api.me();
  } catch (error) {
    if (error instanceof ApiError && error.status === 401) session.ended(texts.session.ended);
  }
}

// The fragment is the route here, so the link moves the focus itself.
function focusContent(event: MouseEvent): void {
  event.preventDefault();
  const content = document.getElementById("content");
  content?.setAttribute("tabindex", "-1");
  content?.focus();
}

/** Said once the connection has been away for a moment, and until it is back. */
function LinkBanner({ fleet }: { fleet: Fleet }) {
  const { state, why } = fleet.link.status.value;
  const [wasUp, setWasUp] = useState(false);
  useSignalEffect(() => {
    if (fleet.link.up.value) setWasUp(true);
  });
  const lost = state === "down" || state === "refused" || (state === "connecting" && (wasUp || why !== ""));
  const trouble = fleet.trouble.value;
  return (
    <div aria-live="assertive">
      {lost && (
        <div class="banner warn" data-testid="link-banner" data-state={state}>
          <strong>{state === "refused" ? texts.link.refused : texts.link.down}</strong>{" "}
          <span>{why !== "" && `${why} `}</span>
          {state === "refused" ? (
            <button type="button" onClick={() => fleet.link.renew()}>
              {texts.link.retry}
            </button>
          ) : (
            texts.link.again
          )}
        </div>
      )}
      {trouble !== null && (
        <div class="banner warn">
          {texts.link.list} {trouble}
        </div>
      )}
    </div>
  );
}
