"""A real browser at the log-in form: what it sends by itself must be what the rules ask for."""

from __future__ import annotations

import pytest
import web_station as station

from ground_station.service.bus import Bus, Router
from ground_station.service.settings import write_run


@pytest.fixture(scope="module")
def process(tmp_path_factory):
    folder = tmp_path_factory.mktemp("locked")
    token = station.write_token(folder)
    write_run(folder, station.run_of(folder, token_file=str(token)))
    router = Router(folder)
    asked: list[dict] = []
    with Bus(folder, "test") as bus, station.web_process(folder) as (_, port):
        bus.serve("intake", lambda request: asked.append(dict(request)) or {})
        yield port, asked
    router.close()


@pytest.fixture
def locked(process):
    """The port of a process that asks for a token, and what the intake is asked."""
    process[1].clear()
    return process


def test_a_browser_logs_in_reads_and_asks(browser, locked):
    port, asked = locked
    here = f"http://127.0.0.1:{port}"
    context = browser.new_context()
    page = context.new_page()
    try:
        page.goto(f"{here}/")
        assert page.url == f"{here}/login"
        page.fill("#token", "not the token")
        with page.expect_navigation():
            page.click("button")
        assert page.locator("[role=alert]").inner_text() == "wrong token"
        page.fill("#token", station.TOKEN)
        with page.expect_navigation(url=f"{here}/"):
            page.click("button")
        assert page.context.cookies()[0]["httpOnly"]
        answer = page.evaluate(
            """async () => (await fetch("/api/recording", {method: "POST",
                headers: {"content-type": "application/json"}, body: '{"active": true}'})).json()"""
        )
        assert answer["done"] and asked == [{"do": "record-start"}]
        first = page.evaluate(
            """() => new Promise((taken, failed) => {
                const live = new WebSocket(`ws://${location.host}/api/live`);
                live.onmessage = (message) => taken(message.data);
                live.onclose = (closed) => failed(new Error(String(closed.code)));
            })"""
        )
        assert first.startswith('{"type":"hello"')
    finally:
        context.close()


def test_a_page_of_another_site_gets_nothing(browser, locked):
    """Another port of the same machine is another site, though cookies are sent to both."""
    port, asked = locked
    here = f"http://127.0.0.1:{port}"
    context = browser.new_context()
    try:
        page = context.new_page()
        page.goto(f"{here}/login")
        page.fill("#token", station.TOKEN)
        with page.expect_navigation(url=f"{here}/"):
            page.click("button")
        evil = context.new_page()
        evil.route("http://127.0.0.1:9/", lambda route: route.fulfill(body="<p>evil</p>"))
        evil.goto("http://127.0.0.1:9/")
        closed = evil.evaluate(
            f"""() => new Promise((taken) => {{
                const live = new WebSocket("ws://127.0.0.1:{port}/api/live");
                live.onmessage = () => taken("opened");
                live.onclose = (closed) => taken(closed.code);
            }})"""
        )
        assert closed == 1006
        sent = evil.evaluate(
            f"""async () => {{
                try {{
                    await fetch("{here}/api/recording", {{method: "POST", mode: "no-cors",
                        credentials: "include", body: '{{"active": true}}'}});
                    return (await fetch("{here}/api/state", {{credentials: "include"}})).status;
                }} catch (error) {{ return "refused"; }}
            }}"""
        )
        assert sent == "refused" and asked == []
    finally:
        context.close()
