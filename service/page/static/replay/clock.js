// The time of a replay: it runs, stands, and is set.

/** A clock from 0 to a length (s). `shown(time_s)` is told each frame; `turned(playing)` when it starts or stops. */
export function clock(shown, turned) {
  const state = { time_s: 0, length_s: 0, rate: 1, playing: false, frame: 0, before: 0 };

  function tick(now) {
    state.frame = requestAnimationFrame(tick);
    if (state.playing) {
      state.time_s = Math.min(state.time_s + (Math.min(now - state.before, 250) / 1000) * state.rate, state.length_s);
      if (state.time_s >= state.length_s) play(false);
    }
    state.before = now;
    shown(state.time_s);
  }

  function play(whether) {
    if (whether && state.time_s >= state.length_s) state.time_s = 0;
    state.playing = whether && state.length_s > 0;
    turned(state.playing);
  }

  state.frame = requestAnimationFrame(tick);
  return {
    state, play,
    set: (time_s) => (state.time_s = Math.min(Math.max(time_s, 0), state.length_s)),
    close: () => cancelAnimationFrame(state.frame),
  };
}
