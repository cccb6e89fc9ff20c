import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { Account } from "../../shared/api/types";
import { storage } from "../../shared/hooks/browser-storage";
import { usePolling } from "../../shared/hooks/use-polling";
import { accountAddress } from "../../shared/routing/routes";
import { browserName, ConfirmedSignIns } from "./model/sign-in-notice";
import { texts } from "./texts";

const POLL_MS = 30_000;

/** Reports sign-ins to the account from unknown browsers until the user confirms them. */
export function SignInNotice({ api, account }: { api: Api; account: Account }) {
  const confirmed = useMemo(() => new ConfirmedSignIns(storage(), account.id), [account.id]);
  const { value: signIns } = usePolling(() => api.account.signIns(), POLL_MS, [api, account.id]);
  const [, setConfirmations] = useState(0);
  const unconfirmed = signIns === null ? [] : confirmed.unconfirmed(signIns);
  const newest = unconfirmed[0];
  return (
    <div aria-live="polite">
      {newest !== undefined && (
        <div class="banner warn" data-testid="sign-in-notice">
          <strong>{texts.signIns.title(unconfirmed.length)}</strong>{" "}
          <span title={newest.program}>{texts.signIns.origin(newest.at, newest.address, browserName(newest.program))}</span>{" "}
          <a href={accountAddress}>{texts.signIns.review}</a>{" "}
          <button
            type="button"
            data-testid="sign-in-confirm"
            onClick={() => {
              confirmed.confirm(unconfirmed);
              setConfirmations((count) => count + 1);
            }}
          >
            {texts.signIns.confirm}
          </button>
        </div>
      )}
    </div>
  );
}
