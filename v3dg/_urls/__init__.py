"""Files at URLs, by fsspec: what is needed of one, or all, comes to files without a
name.

`names` says what is a URL and how one is shown, `addresses` which hosts may be asked,
`http` how web servers are asked and what their answers may cost, `others` the same for
all other places, `failures` what is told of what goes wrong, and `opened` has the
files.
"""

from v3dg._urls.names import beside as beside
from v3dg._urls.names import cleaned as cleaned
from v3dg._urls.names import is_url as is_url
from v3dg._urls.names import shown as shown
from v3dg._urls.opened import FileAtUrl as FileAtUrl
from v3dg._urls.opened import in_parts as in_parts
from v3dg._urls.opened import reading as reading
