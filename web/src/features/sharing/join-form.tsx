import type { Session } from "../account/model";
import { Card } from "../../shared/ui/card";
import { useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import type { FollowedInvitation } from "./model/invitation-link";
import { texts } from "./texts";
import { invitationAddress, replaceWith } from "../../shared/routing/routes";

interface JoinFormProps {
  session: Session;
  followed: FollowedInvitation;
  secret: string;
}

/** Creates an account with an invitation, and accepts the invitation. */
export function JoinForm({ session, followed, secret }: JoinFormProps) {
  const [name, setName] = useState("");
  const [password, setPassword] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");

  const join = async (): Promise<void> => {
    setBusy(true);
    setError("");
    try {
      await session.createAccount(secret, name.trim(), password);
      followed.joined();
      replaceWith(invitationAddress);
    } catch (error) {
      setError(sentence(error)); // The input stays.
      setBusy(false);
    }
  };

  return (
    <Card title={texts.invitation.expected}>
      <form
        class="fields"
        onSubmit={(event) => {
          event.preventDefault();
          void join();
        }}
      >
        <div class="field">
          <label for="join-name">{texts.invitation.name}</label>
          <input
            id="join-name"
            type="text"
            autocomplete="username"
            spellcheck={false}
            required
            maxLength={60}
            value={name}
            aria-describedby="join-name-note join-answer"
            onInput={(event) => setName(event.currentTarget.value)}
          />
          <p id="join-name-note" class="quiet small">
            {texts.invitation.nameNote}
          </p>
        </div>
        <div class="field">
          <label for="join-password">{texts.invitation.password}</label>
          <input
            id="join-password"
            type="password"
            autocomplete="new-password"
            required
            minLength={12}
            value={password}
            aria-describedby="join-password-note join-answer"
            onInput={(event) => setPassword(event.currentTarget.value)}
          />
          <p id="join-password-note" class="quiet small">
            {texts.invitation.passwordNote}
          </p>
        </div>
        <p id="join-answer" class="field-error" aria-live="polite">
          {error}
        </p>
        <div class="row">
          <button type="submit" class="primary" data-testid="join" disabled={busy}>
            {busy ? texts.invitation.joining : texts.invitation.join}
          </button>
          <button type="button" class="plain" disabled={busy} onClick={() => followed.drop()}>
            {texts.invitation.notNow}
          </button>
        </div>
      </form>
    </Card>
  );
}
