"""Tables of one declaration of columns, as text and HTML, and pages."""

from math import nan

from helpers.pages import text_of

from geoscene.drawing.report import Column, Page, table_of

COLUMNS = (
    Column("name", lambda row: row[0]),
    Column("share", lambda row: f"{row[1]:g} (0 to 1)", shade=lambda row: row[2]),
)


def test_a_table_is_aligned_text_and_shaded_html():
    table = table_of(COLUMNS, [("a<b", 0.5, 0.5), ("longer", 1.0, nan)], title="Shares")
    assert table.to_text() == "Shares\nname    share\na<b     0.5 (0 to 1)\nlonger  1 (0 to 1)"
    page = table.to_html()
    assert '<td class="text">a&lt;b</td>' in page
    assert 'rgba(70,150,90,0.33)">0.5<br>(0 to 1)' in page
    assert page.count("style=") == 1


def test_a_page_holds_all_parts_and_no_links():
    page = Page("A & B")
    page.heading("Head")
    page.paragraph("")
    page.paragraph("Words")
    page.points(["one", "two"])
    page.picture(b"png", alt="a picture")
    text = page.encoded().decode()
    assert "<title>A &amp; B</title>" in text
    assert text.count("<p>") == 1
    assert "<ul><li>one</li><li>two</li></ul>" in text
    assert "data:image/png;base64,cG5n" in text
    assert "http" not in text_of(text)
