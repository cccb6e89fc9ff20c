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
  let component: ComponentType<Props> | null = null;
  const fetch = async (): Promise<void> => {
    component = await load();
  };
  function Page(props: Props) {
    const [, setLoaded] = useState(component !== null);
    const [failed, setFailed] = useState(false);
    const [attempt, setAttempt] = useState(0);
    useEffect(() => {
      if (component !== null) {
        setLoaded(true); // Loaded between render and effect.
        return;
      }
      setFailed(false);
      fetch().then(
        () => setLoaded(true),
        () => setFailed(true),
      );
    }, [attempt]);
    if (component !== null) {
      const Loaded = component;
      return <Loaded {...props} />;
    }
    return (
      <main class="page" id="content">
        <p class="quiet" role="status">
          {failed ? common.pageFailed : common.loading}
        </p>
        {failed && (
          <button type="button" onClick={() => setAttempt(attempt + 1)}>
            {common.tryAgain}
          </button>
        )}
      </main>
    );
  }
  return { Page, fetch };
}
