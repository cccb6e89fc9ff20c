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
  /** The error of the last sign-in; empty on a first visit. */
  error: string;
}

export function SignInPage({ api, session, followed, pairing, error }: SignInProps) {
  const [methods, setMethods] = useState<SignInMethods | null>(null);
  useEffect(() => {
    // If the methods cannot be loaded, offer the default method.
    api.signInMethods().then(setMethods, () => setMethods({ password: true, oidc: null }));
  }, [api]);
  const provider = methods?.oidc ?? null;
  const invited = followed.state.value;
  return (
    <main class="narrow" id="content">
      {invited.kind === "open" ? (
        <>
          <h1>{texts.followed.invitation}</h1>
          <p>{texts.followed.invitationExplained}</p>
          {methods?.password === true && <JoinForm session={session} followed={followed} secret={invited.secret} />}
          {provider !== null && (
            <InvitedProviderSignIn api={api} followed={followed} secret={invited.secret} name={provider.name} />
          )}
          <h2>{texts.followed.haveAccount}</h2>
        </>
      ) : (
        <h1>{texts.session.title}</h1>
      )}
      {pairing && invited.kind !== "open" && <p class="notice">{texts.followed.pairing}</p>}
      {error !== "" && (
        <p class="notice bad" role="alert">
          <strong>{texts.session.failed}.</strong> {error}
        </p>
      )}
      {provider !== null && invited.kind !== "open" && (
        <p>
          <a class="elsewhere" data-testid="sign-in-provider" href={provider.url}>
            {texts.session.withProvider(provider.name)}
          </a>
        </p>
      )}
      {methods?.password === true && <PasswordForm session={session} />}
      <h2>{texts.session.byLink}</h2>
      <p>{texts.session.explain}</p>
      <p>{texts.session.linkSource}</p>
      <pre class="command">{texts.session.command}</pre>
      <LinkForm onToken={(token) => void session.start(token)} />
    </main>
  );
}

interface InvitedProviderSignInProps {
  api: Api;
  followed: FollowedInvitation;
  secret: string;
  /** Of the provider. */
  name: string;
}

/** Signs in at the provider with the invitation. A form sends its secret, so that no URL contains it. */
function InvitedProviderSignIn({ api, followed, secret, name }: InvitedProviderSignInProps) {
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const redirect = async (): Promise<void> => {
    setBusy(true);
    setError("");
    try {
      const address = await api.startOpenIdSignIn(secret);
      followed.markAway();
      location.assign(address);
    } catch (error) {
      setError(sentence(error));
      setBusy(false);
    }
  };
  return (
    <div>
      <button type="button" class="primary" data-testid="sign-in-provider" disabled={busy} onClick={() => void redirect()}>
        {busy ? texts.session.redirecting : texts.session.withProvider(name)}
      </button>
      <p class="field-error" aria-live="polite">
        {error}
      </p>
    </div>
  );
}

function PasswordForm({ session }: { session: Session }) {
  const [name, setName] = useState("");
  const [password, setPassword] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");

  const signIn = async (): Promise<void> => {
    setBusy(true);
    setError("");
    try {
      await session.signInWithPassword(name, password);
    } catch (error) {
      setError(sentence(error)); // The input stays.
      setBusy(false);
    }
  };

  return (
    <form
      class="row-form"
      onSubmit={(event) => {
        event.preventDefault();
        void signIn();
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
          aria-invalid={error !== ""}
          aria-describedby="password-error"
          onInput={(event) => setPassword(event.currentTarget.value)}
        />
        <button type="submit" class="primary" data-testid="sign-in" disabled={busy}>
          {texts.session.signIn}
        </button>
      </div>
      <p id="password-error" class="field-error" aria-live="polite">
        {error}
      </p>
    </form>
  );
}

function LinkForm({ onToken }: { onToken: (token: string) => void }) {
  const [pasted, setPasted] = useState("");
  const [invalid, setInvalid] = useState(false);
  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    const fragment = pasted.slice(Math.max(0, pasted.indexOf("#"))).trim();
    const token = signInToken(fragment);
    setInvalid(token === null);
    if (token !== null) onToken(token);
  };
  return (
    <form onSubmit={submit} class="row-form">
      <label for="sign-in-link">{texts.session.pasteLink}</label>
      <div class="row">
        <input
          id="sign-in-link"
          data-testid="sign-in-link"
          type="text"
          autocomplete="off"
          spellcheck={false}
          value={pasted}
          aria-invalid={invalid}
          aria-describedby="sign-in-error"
          onInput={(event) => setPasted(event.currentTarget.value)}
        />
        <button type="submit">{texts.session.use}</button>
      </div>
      <p id="sign-in-error" class="field-error" aria-live="polite">
        {invalid ? texts.session.notALink : ""}
      </p>
    </form>
  );
}
