/** The navigation bar: sections of the console, account and sign-out. */
import type { Account } from "../shared/api/types";
import type { Session } from "../features/account/model/session";
import { texts } from "./texts";
import { PAGES, ROWS } from "./page-registry";
import { accountAddress, deviceListAddress, pageAddress, route } from "../shared/routing/routes";

const LINKS = [...ROWS].flatMap(([page, { link, part }]) => (link === undefined ? [] : [{ link, address: pageAddress(page), part }]));

export function Navigation({ account, session }: { account: Account; session: Session }) {
  const { part: here } = PAGES[route.value.page];
  return (
    <header class="top">
      <a class="brand" href={deviceListAddress}>
        {texts.product}
      </a>
      <nav aria-label={texts.sections.title}>
        {LINKS.filter(({ part }) => part !== "administration" || account.administrator).map(({ link, address, part }) => (
          <a key={part} href={address} aria-current={part === here ? "page" : undefined}>
            {link}
          </a>
        ))}
      </nav>
      <a
        class="account"
        data-testid="signed-in"
        href={accountAddress}
        title={texts.signedInAs(account.name)}
        aria-current={here === "account" ? "page" : undefined}
      >
        {account.name}
      </a>
      <button type="button" class="plain" onClick={() => void session.signOut()}>
        {texts.signOut}
      </button>
    </header>
  );
}
