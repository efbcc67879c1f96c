"""`hdmap export`: a vector map in another format."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("vector_map", type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="File to make.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(["lanelet2", "geojson", "gpkg"]),
    help="Format [default: by OUT's suffix: .osm lanelet2, .geojson and .json geojson, .gpkg gpkg].",
)
@options.origin_option
@options.overwrite_option
@options.json_option
def command(**given: Any) -> None:
    """Write a vector map in another format.

    \b
    Examples:
      hdmap export out/features.gpkg -o lanelet2_map.osm
      hdmap export out/features.gpkg -o map.geojson

    VECTOR_MAP is a GeoPackage, GeoJSON or Lanelet2 file.
    """
    from dataclasses import replace

    from hdmap_tools.errors import ConfigError
    from hdmap_tools.formats.by_name import output_format, read_vector_map, write_vector_map
    from hdmap_tools.geometry.map_frame import MapFrame

    options.require_free_json(given["json_path"], given["overwrite"])
    format_name = output_format(given["out"], given["format_name"])
    vector_map = read_vector_map(given["vector_map"])
    if given["origin"] is not None:
        if vector_map.frame.is_georeferenced:
            raise ConfigError(
                f"{given['vector_map']} knows its place on earth ({vector_map.frame.describe()}); leave "
                "--origin out."
            )
        lat, lon, alt = options.parse_origin(given["origin"])
        vector_map = replace(vector_map, frame=MapFrame.from_origin(lat, lon, alt))
    write_vector_map(vector_map, given["out"], format_name, overwrite=given["overwrite"])
    counts = vector_map.counts()
    options.write_json(
        given["json_path"],
        {"format": format_name, "num_elements": counts},
        overwrite=given["overwrite"],
    )
    click.echo(
        f"{', '.join(f'{n} {name}' for name, n in counts.items()) or 'No elements'} in {given['out']}"
    )
