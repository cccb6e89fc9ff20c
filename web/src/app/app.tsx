import type { Account } from "../shared/api/types";
import { effect, useSignalEffect } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../shared/api/client";
import { ApiError } from "../shared/api/http";
import { Fleet } from "../features/devices/model/device-list";
import type { FollowedInvitation } from "../features/sharing/model/invitation-link";
import type { FollowedCode } from "../features/pairing/model/claim-code";
import type { Session } from "../features/account/model/session";
import { common } from "../shared/i18n/common";
import { texts } from "./texts";
import { lazyPage } from "./lazy-page";
import { Navigation } from "./navigation-bar";
import { type PageProps, ROWS } from "./page-registry";
import { type RouteParameters, route } from "../shared/routing/routes";
import { SecondFactorPage } from "../features/account/second-factor-page";
import { SignInNotice } from "../features/account/sign-in-notice";
import { SignInPage } from "../features/account/sign-in-page";

const LAZY_PAGES = new Map([...ROWS].map(([name, { load }]) => [name, lazyPage(load)]));

/** Preloads the requested page and the operating pages while the session is being checked. */
export function preloadPages(): void {
  for (const [name, { early }] of ROWS) {
    // A failed preload is retried, and reported, when the page opens.
    if (early === true || name === route.value.page) LAZY_PAGES.get(name)?.fetch().catch(() => undefined);
  }
}

interface AppProps {
  api: Api;
  session: Session;
  followed: FollowedInvitation;
  pairing: FollowedCode;
}

export function App({ api, session, followed, pairing }: AppProps) {
  const state = session.state.value;
  switch (state.kind) {
    case "checking":
      return (
        <main class="narrow" id="content">
          <p class="quiet" role="status">
            {texts.checkingSession}
          </p>
        </main>
      );
    case "out":
      return <SignInPage api={api} session={session} followed={followed} pairing={pairing.code.value !== null} error={state.reason} />;
    case "code":
      return <SecondFactorPage session={session} />;
    case "in":
      return (
        <SignedIn
          key={state.account.session}
          api={api}
          session={session}
          followed={followed}
          pairing={pairing}
          account={state.account}
        />
      );
  }
}

interface SignedInProps extends AppProps {
  account: Account;
}

function SignedIn({ api, session, followed, pairing, account }: SignedInProps) {
  const [fleet, setFleet] = useState<Fleet | null>(null);
  useEffect(() => {
    const created = new Fleet(api);
    setFleet(created);
    const disposeEffect = effect(() => {
      // Rejected credentials usually mean an expired session: check it.
      if (created.link.status.value.state === "refused") void checkSession(api, session);
    });
    return () => {
      disposeEffect();
      created.dispose();
    };
  }, [api, session]);
  if (fleet === null) return null;
  return (
    <>
      <a class="skip" href="#content" onClick={focusContent}>
        {texts.skipToContent}
      </a>
      <Navigation account={account} session={session} />
      <LinkBanner fleet={fleet} />
      <SignInNotice api={api} account={account} />
      <CurrentPage api={api} fleet={fleet} account={account} followed={followed} pairing={pairing} />
    </>
  );
}

/** The page of the current address. */
function CurrentPage(props: Omit<PageProps, keyof RouteParameters>) {
  const { page, at } = route.value;
  const title = ROWS.get(page)?.title ?? "";
  const name = typeof title === "string" ? title : title(at, props.fleet);
  useEffect(() => {
    document.title = texts.tabTitle(name);
    return () => {
      document.title = texts.product;
    };
  }, [name]);
  const Page = LAZY_PAGES.get(page)?.Page;
  // What is compared on a page changes without loading the page again.
  const key = `${page} ${Object.values({ ...at, other: "" }).join()}`;
  return Page === undefined ? null : <Page key={key} {...props} {...at} />;
}

async function checkSession(api: Api, session: Session): Promise<void> {
  try {
    await api.me();
  } catch (error) {
    if (error instanceof ApiError && error.status === 401) session.expire(texts.sessionEnded);
  }
}

// The fragment holds the route, so the skip link sets the focus in code.
function focusContent(event: MouseEvent): void {
  event.preventDefault();
  const content = document.getElementById("content");
  content?.setAttribute("tabindex", "-1");
  content?.focus();
}

/** Notice while the connection is lost, shown after a short delay. */
function LinkBanner({ fleet }: { fleet: Fleet }) {
  const { state, reason } = fleet.link.status.value;
  const [wasUp, setWasUp] = useState(false);
  useSignalEffect(() => {
    if (fleet.link.up.value) setWasUp(true);
  });
  const lost = state === "down" || state === "refused" || (state === "connecting" && (wasUp || reason !== ""));
  const error = fleet.error.value;
  return (
    <div aria-live="assertive">
      {lost && (
        <div class="banner warn" data-testid="link-banner" data-state={state}>
          <strong>{state === "refused" ? texts.link.refused : texts.link.down}</strong>{" "}
          <span>{reason !== "" && `${reason} `}</span>
          {state === "refused" ? (
            <button type="button" onClick={() => fleet.link.renew()}>
              {common.tryAgain}
            </button>
          ) : (
            texts.link.reconnecting
          )}
        </div>
      )}
      {error !== null && (
        <div class="banner warn">
          {texts.link.deviceListFailed} {error}
        </div>
      )}
    </div>
  );
}
