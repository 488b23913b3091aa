/* Order of what a search finds: pages whose title or address begins with the words first, lists of everything last. */
var Scorer = {
  score: ([page, title, , , score]) => {
    const words = (new URLSearchParams(location.search).get("q") || "").toLowerCase().split(/\W+/).filter(Boolean);
    const told = `${page} ${title}`.toLowerCase(), has = word => new RegExp(`(^|[^a-z])${word.replace(/s$/, "")}`).test(told);
    const list = /^(project\/|lessons\/(items|figures)|architecture|api\/kalmark.models.protocols)/.test(page);
    return score + 20 * words.filter(has).length / Math.max(words.length, 1) - (list ? 20 : 0);
  },
  objNameMatch: 11, objPartialMatch: 6, objPrio: {0: 15, 1: 5, 2: -5}, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};
