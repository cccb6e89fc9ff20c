import { useState } from "preact/hooks";
import { signInToken } from "../core/session";
import { texts } from "../texts";

interface SignInProps {
  /** What went wrong before; empty at a first visit. */
  why: string;
  onToken: (token: string) => void;
}

export function SignIn({ why, onToken }: SignInProps) {
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
    <main class="narrow" id="content">
      <h1>{texts.session.title}</h1>
      {why !== "" && (
        <p class="notice bad" role="alert">
          <strong>{texts.session.failed}.</strong> {why}
        </p>
      )}
      <p>{texts.session.explain}</p>
      <p>{texts.session.where}</p>
      <pre class="command">{texts.session.command}</pre>
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
          <button type="submit" class="primary">
            {texts.session.use}
          </button>
        </div>
        <p id="sign-in-wrong" class="field-error" aria-live="polite">
          {wrong ? texts.session.notALink : ""}
        </p>
      </form>
    </main>
  );
}
