import { effect, useSignalEffect } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import type { Account, Api } from "../core/api";
import { ApiError } from "../core/http";
import { Fleet } from "../core/fleet";
import type { FollowedInvitation } from "../core/invitation";
import type { FollowedCode } from "../core/pairing";
import type { Session } from "../core/session";
import { texts } from "../texts";
import { AccountPage } from "./account-page";
import { ActivityPage } from "./activity-page";
import { DevicePage } from "./device-page";
import { FleetPage } from "./fleet-page";
import { InvitationPage } from "./invitation-page";
import { later } from "./later";
import { Navigation } from "./navigation";
import { route } from "./route";
import { SignIn } from "./sign-in";
import { SpacePage } from "./space-page";

const TogetherPage = later(() => import("./steer/together-page").then((page) => page.TogetherPage));
const RobotTypesPage = later(() => import("./robot-types/list-page").then((page) => page.RobotTypesPage));
const AddRobotTypePage = later(() => import("./robot-types/add-page").then((page) => page.AddRobotTypePage));
const RobotTypePage = later(() => import("./robot-types/type-page").then((page) => page.RobotTypePage));
const HealthPage = later(() => import("./health-page").then((part) => part.HealthPage));
const TimesPage = later(() => import("./times-page").then((part) => part.TimesPage));
const LibraryPage = later(() => import("./movements/library-page").then((found) => found.LibraryPage));
const EditorPage = later(() => import("./movements/editor-page").then((found) => found.EditorPage));
const PairingPage = later(async () => (await import("./pairing-page")).PairingPage);

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
            {texts.session.checking}
          </p>
        </main>
      );
    case "out":
      return <SignIn api={api} session={session} followed={followed} pairing={pairing.code.value !== null} why={state.why} />;
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

const KeyframesPage = later(() => import("./keyframes/page").then((page) => page.KeyframesPage));

interface SignedInProps extends AppProps {
  account: Account;
}

function SignedIn({ api, session, followed, pairing, account }: SignedInProps) {
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
      <Navigation account={account} session={session} />
      <LinkBanner fleet={fleet} />
      {at.page === "fleet" && <FleetPage api={api} fleet={fleet} />}
      {at.page === "keyframes" && (
        <KeyframesPage key={`${at.id}/${at.name}`} api={api} fleet={fleet} account={account} id={at.id} name={at.name} />
      )}
      {at.page === "account" && <AccountPage api={api} fleet={fleet} />}
      {at.page === "activity" && <ActivityPage api={api} fleet={fleet} />}
      {at.page === "invitation" && (
        <InvitationPage api={api} fleet={fleet} account={account} followed={followed} />
      )}
      {at.page === "robot-types" && <RobotTypesPage api={api} fleet={fleet} />}
      {at.page === "add-robot-type" && <AddRobotTypePage api={api} />}
      {at.page === "robot-type" && <RobotTypePage key={at.id} api={api} fleet={fleet} id={at.id} />}
      {at.page === "health" && (
        <HealthPage key={at.device + at.space} api={api} fleet={fleet} account={account} device={at.device} space={at.space} />
      )}
      {at.page === "times" && (
        <TimesPage key={at.device} api={api} fleet={fleet} account={account} device={at.device} />
      )}
      {at.page === "movements" && <LibraryPage api={api} fleet={fleet} />}
      {at.page === "movement" && (
        <EditorPage
          key={`${at.robotType}/${at.name}`}
          api={api}
          fleet={fleet}
          account={account}
          robotType={at.robotType}
          name={at.name}
        />
      )}
      {at.page === "pair" && <PairingPage api={api} fleet={fleet} followed={pairing} />}
      {at.page === "space" && <SpacePage key={at.id} api={api} fleet={fleet} account={account} id={at.id} />}
      {at.page === "together" && (
        <TogetherPage key={at.ids.join()} api={api} fleet={fleet} ids={at.ids} account={account} />
      )}
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
