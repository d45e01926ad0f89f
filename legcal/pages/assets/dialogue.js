(() => {
  const box = document.getElementById("dialogue");
  const post = async (path, text) => {
    const answer = await fetch(path, { method: "POST", headers: { "X-Legcal-Token": box.dataset.token }, body: text });
    return answer.json();
  };
  const fill = (name, lines) => box.querySelector(`[data-list=${name}]`)
    .replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
  const show = (state) => {
    fill("asked", state.prompt.length ? state.prompt : ["No photograph is asked."]);
    fill("said", state.lines.toReversed());
    box.querySelector("[data-known]").textContent = state.known;
    const bar = box.querySelector("progress");
    bar.max = state.of;
    bar.value = state.taken;
  };
  const look = async () => {
    try { show(await post("state", "")); } catch { box.querySelector("[data-known]").textContent = "legcal shoot has ended."; }
  };
  box.querySelector("form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const field = event.target.elements.word;
    const word = event.submitter?.hasAttribute("value") ? event.submitter.value : field.value;
    field.value = "";
    try { show(await post("word", word)); } catch { await look(); }
  });
  look();
  setInterval(look, 1000);
})();
