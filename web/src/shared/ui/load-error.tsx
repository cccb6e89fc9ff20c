import { texts } from "../i18n/texts";

/** Why something did not come, with another try; nothing where all is well. */
export function Trouble({ said, again }: { said: string; again: () => void }) {
  if (said === "") return null;
  return (
    <p class="notice bad row" role="alert">
      <span>{texts.robotTypes.failed(said)}</span>
      <button type="button" onClick={again}>
        {texts.later.again}
      </button>
    </p>
  );
}
