/** A page whose code comes when it is opened, so that the first load stays small. */
import type { ComponentType } from "preact";
import { useEffect, useState } from "preact/hooks";
import { texts } from "../texts";

/** The page that `load` brings; it says so while that takes, and offers another try where it fails. */
export function later<Props extends object>(load: () => Promise<ComponentType<Props>>): ComponentType<Props> {
  let known: ComponentType<Props> | null = null;
  return function Later(props: Props) {
    const [, setCame] = useState(known !== null);
    const [failed, setFailed] = useState(false);
    const [tries, setTries] = useState(0);
    useEffect(() => {
      if (known !== null) return;
      setFailed(false);
      load().then(
        (page) => {
          known = page;
          setCame(true);
        },
        () => setFailed(true),
      );
    }, [tries]);
    if (known !== null) {
      const Page = known;
      return <Page {...props} />;
    }
    return (
      <main class="page" id="content">
        <p class="quiet" role="status">
          {failed ? texts.later.failed : texts.loading}
        </p>
        {failed && (
          <button type="button" onClick={() => setTries(tries + 1)}>
            {texts.later.again}
          </button>
        )}
      </main>
    );
  };
}
