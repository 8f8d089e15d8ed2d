"use strict";
// Of a render that goes on: asks each second how far it is, and puts newer pictures in place of those on the page.
const told = make("span", {role: "status"}, "rendering");
const enough = make("button", {title: "End the render with the pass that runs, and write what there is, as Ctrl-C does"}, "enough");
enough.onclick = async () => {
  enough.disabled = true;
  const answer = await fetch("/enough", {method: "POST"});
  if (!answer.ok) complain("The render did not take it: " + answer.status);
};
document.querySelector("header").append(make("div", {id: "live"}, told, enough));

async function renew() {
  const fresh = new DOMParser().parseFromString(await (await fetch("/")).text(), "text/html");
  Object.assign(page, JSON.parse(fresh.getElementById("page").textContent));
  for (const packed of document.querySelectorAll("script[id^=pixels-]")) packed.textContent = fresh.getElementById(packed.id).textContent;
  for (const figure of figures(0)) {
    const other = [...fresh.querySelectorAll("figure")].find(other => other.dataset.name === figure.dataset.name);
    figure.querySelector(".frame").replaceChildren(...other.querySelector(".frame").childNodes);
  }
  $("scene-0").querySelector(".caption").textContent = fresh.querySelector(".caption").textContent;
  held.clear();
  fillMaps();  // Samples may differ by now.
  await show();
}

async function ask() {
  try {
    const news = await (await fetch("/status")).json();
    told.textContent = news.text;
    enough.hidden = news.ended;
    if (news.number > page.live) await renew();
    if (!news.ended) setTimeout(ask, 1000);
  } catch (error) {
    if (!(error instanceof TypeError)) throw error;  // what fetch throws where nobody answers
    told.textContent = "the render is gone";
    enough.hidden = true;
  }
}
ask();
