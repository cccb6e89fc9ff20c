/** A page whose code loads when it opens, to keep the first load small. */
import type { ComponentType } from "preact";
import { useEffect, useState } from "preact/hooks";
import { common } from "../shared/i18n/common";

interface LazyPage<Props> {
  /** Renders the page, a loading state, or an error with a retry button. */
  Page: ComponentType<Props>;
  /** Loads the code in advance. */
  fetch: () => Promise<void>;
}

export function lazyPage<Props extends object>(load: () => Promise<ComponentType<Props>>): LazyPage<Props> {
  let known: ComponentType<Props> | null = null;
  const fetch = async (): Promise<void> => {
    known = await load();
  };
  function Page(props: Props) {
    const [, setCame] = useState(known !== null);
    const [failed, setFailed] = useState(false);
    const [tries, setTries] = useState(0);
    useEffect(() => {
      if (known !== null) {
        setCame(true); // It came between the drawing and now.
        return;
      }
      setFailed(false);
      fetch().then(
        () => setCame(true),
        () => setFailed(true),
      );
    }, [tries]);
    if (known !== null) {
      const Known = known;
      return <Known {...props} />;
    }
    return (
      <main class="page" id="content">
        <p class="quiet" role="status">
          {failed ? common.pageFailed : common.loading}
        </p>
        {failed && (
          <button type="button" onClick={() => setTries(tries + 1)}>
            {common.tryAgain}
          </button>
        )}
      </main>
    );
  }
  return { Page, fetch };
}
