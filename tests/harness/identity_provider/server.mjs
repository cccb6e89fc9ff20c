// An OpenID Connect provider for tests. The first line of its standard input is its configuration:
// {port, client: {...}, keys: [JWK, …]}; it prints its address when it listens, and exits when standard input ends.
import { createServer } from "node:http";
import { createInterface } from "node:readline";
import Provider from "oidc-provider";

const lines = createInterface({ input: process.stdin });
lines.on("close", () => process.exit());
lines.once("line", (line) => {
  const { port, client, keys } = JSON.parse(line);
  const server = createServer((request, response) => answer(request, response));
  let answer;
  server.listen(port, "127.0.0.1", () => {
    const issuer = `http://127.0.0.1:${server.address().port}`;
    // Accepts every account name without a password, with the development forms of the package.
    const provider = new Provider(issuer, {
      clients: [client],
      jwks: { keys },
      cookies: { keys: ["of the tests"] },
      claims: { openid: ["sub"], profile: ["name"] },
      conformIdTokenClaims: false,
      findAccount: (_context, id) => ({ accountId: id, claims: () => ({ sub: id, name: `Name of ${id}` }) }),
      pkce: { required: () => true },
    });
    answer = provider.callback();
    console.log(`listening at ${issuer}`);
  });
});
