import { CodeForm } from "./code-form";
import type { Session } from "./model/session";
import { texts } from "./texts";

/** The second step of a sign-in. */
export function SecondFactorPage({ session }: { session: Session }) {
  return (
    <main class="narrow" id="content">
      <h1>{texts.factor.required}</h1>
      <p>{texts.factor.requiredExplained}</p>
      <CodeForm
        id="sign-in-code"
        label={texts.factor.code}
        submit={texts.session.signIn}
        onSubmit={(code) => session.submitCode(code)}
        onCancel={() => session.cancelCode()}
      />
      <p class="quiet">{texts.factor.lost}</p>
    </main>
  );
}
