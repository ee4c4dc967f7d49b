// SPDX-License-Identifier: Apache-2.0
// Which events the page holds on to.

/** At most `most` of them: the oldest checkpoints and other routine events go first, of which many units make
    thousands in a minute; what the history has, the crashes among it, stays. */
export function kept(events, most) {
  if (events.length <= most) return events;
  let routine = most / 4;
  const left = events.filter((event) => event.seq || routine-- <= 0);
  return left.length > most ? left.slice(most / 4) : left;
}
