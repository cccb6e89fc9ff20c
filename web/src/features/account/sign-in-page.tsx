import type { SignInMethods } from "../../shared/api/types";
import { JoinForm } from "../sharing";
import type { FollowedInvitation } from "../sharing/model";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { signInToken, type Session } from "./model/session";
import { texts } from "./texts";

interface SignInProps {
  api: Api;
  session: Session;
  followed: FollowedInvitation;
  /** The user followed an agent's pairing link. */
  pairing: boolean;
  /** The previous error; empty on a first visit. */
  why: string;
}

export function SignInPage({ api, session, followed, pairing, why }: SignInProps) {
  const [methods, setMethods] = useState<SignInMethods | null>(null);
  useEffect(() => {
    // If the methods cannot be loaded, offer the default method.
    api.signInMethods().then(setMethods, () => setMethods({ password: true, oidc: null }));
  }, [api]);
  const elsewhere = methods?.oidc ?? null;
  const invited = followed.state.value;
  return (
    <main class="narrow" id="content">
      {invited.kind === "open" ? (
        <>
          <h1>{texts.followed.invitation}</h1>
          <p>{texts.followed.invitationExplained}</p>
          {methods?.password === true && <JoinForm session={session} followed={followed} secret={invited.secret} />}
          {elsewhere !== null && (
            <InvitedElsewhere api={api} followed={followed} secret={invited.secret} name={elsewhere.name} />
          )}
          <h2>{texts.followed.haveAccount}</h2>
        </>
      ) : (
        <h1>{texts.session.title}</h1>
      )}
      {pairing && invited.kind !== "open" && <p class="notice">{texts.followed.pairing}</p>}
      {why !== "" && (
        <p class="notice bad" role="alert">
          <strong>{texts.session.failed}.</strong> {why}
        </p>
      )}
      {elsewhere !== null && invited.kind !== "open" && (
        <p>
          <a class="elsewhere" data-testid="sign-in-elsewhere" href={elsewhere.url}>
            {texts.session.elsewhere(elsewhere.name)}
          </a>
        </p>
      )}
      {methods?.password === true && <PasswordForm session={session} />}
      <h2>{texts.session.byLink}</h2>
      <p>{texts.session.explain}</p>
      <p>{texts.session.where}</p>
      <pre class="command">{texts.session.command}</pre>
      <LinkForm onToken={(token) => void session.start(token)} />
    </main>
  );
}

interface InvitedElsewhereProps {
  api: Api;
  followed: FollowedInvitation;
  secret: string;
  /** Of the provider. */
  name: string;
}

/** Signs in at the provider with the invitation. A form sends its secret, so that no URL contains it. */
function InvitedElsewhere({ api, followed, secret, name }: InvitedElsewhereProps) {
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const go = async (): Promise<void> => {
    setBusy(true);
    setWrong("");
    try {
      const address = await api.startOpenIdSignIn(secret);
      followed.leave();
      location.assign(address);
    } catch (error) {
      setWrong(sentence(error));
      setBusy(false);
    }
  };
  return (
    <div>
      <button type="button" class="primary" data-testid="sign-in-elsewhere" disabled={busy} onClick={() => void go()}>
        {busy ? texts.session.leaving : texts.session.elsewhere(name)}
      </button>
      <p class="field-error" aria-live="polite">
        {wrong}
      </p>
    </div>
  );
}

function PasswordForm({ session }: { session: Session }) {
  const [name, setName] = useState("");
  const [password, setPassword] = useState("");
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");

  const enter = async (): Promise<void> => {
    setBusy(true);
    setWrong("");
    try {
      await session.enter(name, password);
    } catch (error) {
      setWrong(sentence(error)); // What was typed stays.
      setBusy(false);
    }
  };

  return (
    <form
      class="row-form"
      onSubmit={(event) => {
        event.preventDefault();
        void enter();
      }}
    >
      <label for="sign-in-name">{texts.session.name}</label>
      <div class="row">
        <input
          id="sign-in-name"
          data-testid="sign-in-name"
          type="text"
          autocomplete="username"
          autocapitalize="none"
          spellcheck={false}
          required
          maxLength={200}
          value={name}
          onInput={(event) => setName(event.currentTarget.value)}
        />
      </div>
      <label for="sign-in-password">{texts.session.password}</label>
      <div class="row">
        <input
          id="sign-in-password"
          data-testid="sign-in-password"
          type="password"
          autocomplete="current-password"
          required
          value={password}
          aria-invalid={wrong !== ""}
          aria-describedby="password-wrong"
          onInput={(event) => setPassword(event.currentTarget.value)}
        />
        <button type="submit" class="primary" data-testid="sign-in" disabled={busy}>
          {texts.session.enter}
        </button>
      </div>
      <p id="password-wrong" class="field-error" aria-live="polite">
        {wrong}
      </p>
    </form>
  );
}

function LinkForm({ onToken }: { onToken: (token: string) => void }) {
  const [pasted, setPasted] = useState("");
  const [wrong, setWrong] = useState(false);
  const use = (event: SubmitEvent): void => {
    event.preventDefault();
    const fragment = pasted.slice(Math.max(0, pasted.indexOf("#"))).trim();
    const token = signInToken(fragment);
    setWrong(token === null);
    if (token !== null) onToken(token);
  };
  return (
    <form onSubmit={use} class="row-form">
      <label for="sign-in-link">{texts.session.pasted}</label>
      <div class="row">
        <input
          id="sign-in-link"
          data-testid="sign-in-link"
          type="text"
          autocomplete="off"
          spellcheck={false}
          value={pasted}
          aria-invalid={wrong}
          aria-describedby="sign-in-wrong"
          onInput={(event) => setPasted(event.currentTarget.value)}
        />
        <button type="submit">{texts.session.use}</button>
      </div>
      <p id="sign-in-wrong" class="field-error" aria-live="polite">
        {wrong ? texts.session.notALink : ""}
      </p>
    </form>
  );
}
