import { useEffect, useRef, useState } from "preact/hooks";
import type { ActionRunner } from "./model/action-runner";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";

const LONGEST = 2000;
/** A BCP 47 tag: `en`, `sk`, `en-GB`; or empty. */
const LANGUAGE = /^([A-Za-z]{1,8}(-[A-Za-z0-9]{1,8})*)?$/;

/** Enter sends the text; Shift+Enter starts a new line. The text is cleared only after success. */
export function SpeechCard({ session, no }: ActionCardProps) {
  const [text, setText] = useState("");
  const [language, setLanguage] = useState("");
  const asked = useRef("");
  useSaid(session.actions, asked, (said) => setText((now) => (now === said ? "" : now)));
  const good = LANGUAGE.test(language.trim());
  const ready = no === "" && text.trim() !== "" && good;
  const say = (): void => {
    if (!ready) return;
    asked.current = text;
    startAction(session, { kind: "say", text: text.trim(), language: language.trim() });
  };
  return (
    <form
      class="act-speech"
      onSubmit={(event) => {
        event.preventDefault();
        say();
      }}
    >
      <label>
        {texts.say}
        <textarea
          rows={2}
          maxLength={LONGEST}
          value={text}
          data-testid="say-text"
          onInput={(event) => setText(event.currentTarget.value)}
          onKeyDown={(event) => {
            if (event.key !== "Enter" || event.shiftKey || event.isComposing) return;
            event.preventDefault();
            say();
          }}
        />
      </label>
      <div class="row">
        <label class="act-language">
          {texts.language}
          <input
            type="text"
            list="say-languages"
            value={language}
            placeholder={texts.ownLanguage}
            aria-invalid={!good}
            autocapitalize="off"
            data-testid="say-language"
            onInput={(event) => setLanguage(event.currentTarget.value)}
          />
        </label>
        <datalist id="say-languages">
          {Object.entries(texts.languages).map(([code, name]) => (
            <option key={code} value={code}>
              {name}
            </option>
          ))}
        </datalist>
        <button type="submit" class="primary" data-testid="say" disabled={!ready} title={no === "" ? undefined : no}>
          {texts.sayIt}
        </button>
      </div>
    </form>
  );
}

/** Calls back once when the speech starts. */
function useSaid(actions: ActionRunner, asked: { current: string }, said: (text: string) => void): void {
  const run = actions.run.value;
  const begun = run?.request.kind === "say" && (run.status === "started" || run.status === "done") ? run.key : "";
  useEffect(() => {
    if (begun !== "") said(asked.current);
  }, [begun]);
}
