/** What the page shows stands in its address (#seed=3&beside=untrained), so that a link leads to the same. */

const told = () => new URLSearchParams(location.hash.slice(1));

/** What the address says, or null. */
export const asked = (key) => told().get(key);

/** Puts something into the address; null takes it out. */
export function tell(key, value) {
  const words = told();
  if (value === null) words.delete(key);
  else words.set(key, value);
  history.replaceState(null, "", words.size > 0 ? `#${words}` : location.pathname + location.search);
}
